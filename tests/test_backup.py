"""Backups of changes.db, and the thread that makes them."""

import os
import sqlite3
import time

import pytest
from stored import make_change

from revisitd.daemon.config import Config, StorageConfig
from revisitd.daemon.housekeeping import Housekeeping
from revisitd.storage.backup import back_up_if_due, backups
from revisitd.storage.changes import ChangeStore
from revisitd.storage.errors import StorageFull
from revisitd.storage.store import Store

HOUR_S = 3600.0


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        store.changes.add(make_change())
        yield store


def again(store):
    """Another backup, of what has changed."""
    store.changes.add(make_change())
    return back_up_if_due(store.dir, HOUR_S, kept=3)


def aged(path, hours):
    """Make a file look older, and a name that sorts before."""
    os.utime(path, times=(time.time() - hours * HOUR_S,) * 2)
    return path.rename(path.with_name(f"changes-2025010{9 - hours}T000000Z.db"))


def test_a_backup_holds_all_changes_and_opens_as_the_store_does(store):
    change_id = store.changes.add(make_change())
    made = back_up_if_due(store.dir, HOUR_S, kept=3)
    copy = ChangeStore.open_reader(made)
    assert copy.get(change_id).n_points == 50
    copy.close()


def test_a_backup_is_made_when_the_last_is_old_enough(store):
    first = back_up_if_due(store.dir, HOUR_S, kept=3)
    assert back_up_if_due(store.dir, HOUR_S, kept=3) is None
    first = aged(first, hours=2)
    second = again(store)
    assert backups(store.dir) == [first, second]


def test_what_has_not_changed_is_not_backed_up_again(store):
    aged(back_up_if_due(store.dir, HOUR_S, kept=3), hours=2)
    assert back_up_if_due(store.dir, HOUR_S, kept=3) is None


def test_an_empty_store_is_not_backed_up(tmp_path):
    with Store.open_writer(tmp_path / "empty") as store:
        assert back_up_if_due(store.dir, HOUR_S, kept=3) is None


def test_the_newest_backups_are_kept(store):
    for hours in (4, 3, 2):
        aged(again(store), hours)
    store.changes.add(make_change())
    made = back_up_if_due(store.dir, HOUR_S, kept=2)
    assert [path.name for path in backups(store.dir)] == ["changes-20250107T000000Z.db", made.name]


def test_a_backup_that_fails_costs_no_older_one_and_leaves_nothing(store, monkeypatch):
    old = aged(back_up_if_due(store.dir, HOUR_S, kept=1), hours=2)
    store.changes.add(make_change())
    full = StorageFull("disk full")

    def fail(*_):
        raise full

    monkeypatch.setattr("revisitd.storage.backup.check_whole", fail)
    with pytest.raises(StorageFull):
        back_up_if_due(store.dir, HOUR_S, kept=1)
    assert backups(store.dir) == [old]
    monkeypatch.undo()
    back_up_if_due(store.dir, HOUR_S, kept=9)
    assert len(list(store.dir.backups_path.iterdir())) == 2


def test_backups_do_not_wait_for_a_writer_of_another_program(store):
    other = sqlite3.connect(store.dir.changes_path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    assert back_up_if_due(store.dir, HOUR_S, kept=3) is not None
    other.close()


def test_the_housekeeping_backs_up_and_keeps_the_quota_until_it_is_closed(store):
    config = Config(storage=StorageConfig(quota_gb=10.0))
    with Housekeeping(store, config) as housekeeping:
        deadline = time.monotonic() + 20.0
        while not (backups(store.dir) and housekeeping.figures.used_bytes) and time.monotonic() < deadline:
            time.sleep(0.01)
    assert len(backups(store.dir)) == 1
    assert housekeeping.figures.problem == ""
