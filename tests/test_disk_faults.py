"""Full disks, read-only disks and locked databases: nothing acknowledged is lost, and it goes on when they are over."""

import contextlib
import os
import sqlite3
import subprocess
import time

import numpy as np
import pytest
from stored import SESSION, add_visit, make_change, make_scan

from revisitd.daemon.config import Config
from revisitd.daemon.instances import ChangeDetection
from revisitd.daemon.scenes import Scene, SceneUpdate, Visit
from revisitd.daemon.session import Session
from revisitd.storage.errors import StorageBusy, StorageFull, StorageReadOnly, StorageUnavailable
from revisitd.storage.store import Store


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 6 MB, full of nothing."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounting = ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(mounting, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small file system can only be mounted by root")
    yield disk
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        yield store


def fill(disk, leave=0):
    """Another program takes all the space, but for some bytes."""
    with open(disk / "filler", "wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    os.truncate(disk / "filler", (disk / "filler").stat().st_size - leave)


def test_a_full_disk_costs_the_key_scans_of_that_time_alone(small_disk):
    with Store.open_writer(small_disk / "data") as store:
        session = store.index.start_session(**SESSION)
        before = add_visit(store, 1, 1, session, 5)
        store.changes.add(make_change())
        fill(small_disk)
        for _ in range(20):
            with pytest.raises(StorageFull, match="no space left: free some, or lower storage.quota_gb"):
                store.add_scan(make_scan(store.new_scan_id(), session, shape=(32, 256)))
        for _ in range(100):
            with contextlib.suppress(StorageFull):  # its WAL has some room at first
                store.changes.add(make_change(at=(9.0, 0.0, 0.0), n_points=1000))
        n_changes = len(store.changes.changes())
        (small_disk / "filler").unlink()
        after = store.new_scan_id()
        store.add_scan(make_scan(after, session))
    with Store.open_writer(small_disk / "data") as store:
        assert store.repairs == []
        assert store.index.trajectory().scan_id.tolist() == [*before, after]
        assert [scan_id for _, scan_id in store.scans.iter_ids()] == [*before, after]
        assert len(store.changes.changes()) == n_changes


def test_a_full_disk_is_freed_by_the_retention_which_needs_some_space_itself(small_disk):
    with Store.open_writer(small_disk / "data") as store:
        session = store.index.start_session(**SESSION)
        keeper = store.retention(quota_bytes=10**9, min_free_bytes=200_000, kept_per_visit=2, recent_ns=0)
        keeper.step()
        for number in (1, 2, 3):
            add_visit(store, 1, number, session, 10, first_ns=number * 10**11, shape=(32, 256))
        store.index.db.write("PRAGMA wal_checkpoint(TRUNCATE)")
        fill(small_disk)
        assert keeper.step().n_deleted > 0
        store.add_scan(make_scan(store.new_scan_id(), session))


def test_a_store_on_a_full_disk_opens(small_disk):
    with Store.open_writer(small_disk / "data") as store:
        session = store.index.start_session(**SESSION)
        ids = add_visit(store, 1, 1, session, 5)
        store.retention(quota_bytes=10**9, min_free_bytes=0, kept_per_visit=2, recent_ns=0).step()
    fill(small_disk)
    with Store.open_writer(small_disk / "data") as store:
        assert store.index.trajectory().scan_id.tolist() == ids


def test_on_a_full_disk_the_settings_of_the_run_before_stay_whole(small_disk):
    with Store.open_writer(small_disk / "data") as store:
        store.dir.put_settings("[detection]\n")
        fill(small_disk)
        with pytest.raises(StorageFull, match="config.toml: no space left: free some"):
            store.dir.put_settings("# as long as a real one\n" * 1000)
        assert (small_disk / "data/config.toml").read_text() == "[detection]\n"
        assert list((small_disk / "data/sensors").iterdir()) == []


@pytest.mark.parametrize("leave", range(0, 80_000, 8192))
def test_a_write_that_fails_at_any_depth_leaves_nothing_of_itself(small_disk, leave):
    with Store.open_writer(small_disk / "data") as store:
        session = store.index.start_session(**SESSION)
        add_visit(store, 1, 1, session, 3)
        store.index.db.write("PRAGMA wal_checkpoint(TRUNCATE)")
        fill(small_disk, leave)
        acknowledged = store.index.trajectory().scan_id.tolist()
        with contextlib.suppress(StorageFull):
            while True:
                scan_id = store.new_scan_id()
                store.add_scan(make_scan(scan_id, session), [store.index.visits(1)[0].visit_id])
                acknowledged.append(scan_id)
        assert [scan_id for _, scan_id in store.scans.iter_ids()] == acknowledged
        assert store.index.trajectory().scan_id.tolist() == acknowledged
        assert store.index.scans_of_scene(1).scan_id.tolist() == acknowledged


def test_a_read_only_disk_is_named_at_the_start(small_disk):
    Store.open_writer(small_disk / "data").close()
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(StorageReadOnly, match="read-only"):
        Store.open_writer(small_disk / "data")
    Store.open_reader(small_disk / "data").close()


@pytest.mark.parametrize(
    "code,kind", [(28, StorageFull), (122, StorageFull), (30, StorageReadOnly), (5, StorageUnavailable)]
)
def test_what_a_disk_refuses_is_named_and_not_half_stored(store, monkeypatch, code, kind):
    session = store.index.start_session(**SESSION)

    def refuse(_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("os.fsync", refuse)
    with pytest.raises(kind, match=r"1\.scan: "):
        store.add_scan(make_scan(store.new_scan_id(), session))
    monkeypatch.undo()
    assert list(store.scans.iter_ids()) == []
    assert len(store.index.trajectory().scan_id) == 0


def test_an_index_that_takes_no_row_leaves_no_file(store):
    session = store.index.start_session(**SESSION)
    pages = store.index.db.value("PRAGMA page_count")
    store.index.db.write(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StorageFull, match="index.db: no space left"):
        for _ in range(100):
            store.add_scan(make_scan(store.new_scan_id(), session))
    known = store.index.trajectory().scan_id.tolist()
    assert [scan_id for _, scan_id in store.scans.iter_ids()] == known


# Locks --------------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def locked(path):
    """Another program is in the midst of writing."""
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    yield
    other.execute("ROLLBACK")
    other.close()


def test_a_locked_index_holds_the_frame_loop_for_a_moment_only(store):
    session = store.index.start_session(**SESSION)
    with locked(store.dir.index_path):
        start = time.monotonic()
        with pytest.raises(StorageBusy, match="index.db: another program writes to it"):
            store.add_scan(make_scan(store.new_scan_id(), session))
        assert store.index.db.value("PRAGMA busy_timeout") == 200
        assert time.monotonic() - start < 30.0
    store.add_scan(make_scan(store.new_scan_id(), session))


def test_a_reader_in_a_long_transaction_holds_nobody_up(store):
    session = store.index.start_session(**SESSION)
    readers = [sqlite3.connect(f"file:{path}?mode=ro", uri=True, isolation_level=None)
               for path in (store.dir.index_path, store.dir.changes_path)]  # fmt: skip
    for reader in readers:
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    add_visit(store, 1, 1, session, 5)
    store.changes.add(make_change())
    for reader in readers:
        reader.close()


def test_visits_that_end_while_the_index_is_locked_are_recorded_after(store):
    session = store.index.start_session(**SESSION)
    scans = [store.new_scan_id() for _ in range(3)]
    for scan_id in scans:
        store.add_scan(make_scan(scan_id, session))
    recorder = Session.__new__(Session)  # one that only records
    recorder._store, recorder._config, recorder._unrecorded = store, Config(), []
    recorder.session_id = recorder.map_id = session
    made = SceneUpdate(Scene(1, np.zeros((1, 2))), [Visit(1, 1, 0, 1, scans[:2])])
    with locked(store.dir.index_path), pytest.raises(StorageBusy):
        recorder.record(made)
    due = recorder.record(SceneUpdate(None, [Visit(1, 2, 2, 3, scans[2:])]))
    assert [instance.visit for instance in due] == [2]
    assert [visit.number for visit in store.index.visits(1)] == [1, 2]
    assert store.index.scans_of_scene(1).scan_id.tolist() == scans
    assert recorder.record(SceneUpdate(None, [])) == []


def test_what_was_found_waits_until_changes_db_is_free(store, monkeypatch):
    monkeypatch.setattr("revisitd.daemon.instances.RETRY_S", 0.0)
    detection = ChangeDetection(Config(), store, process=None, model=None)
    attempts = []

    def record():
        attempts.append(1)
        if len(attempts) < 3:
            raise StorageBusy("changes.db: another program writes to it")
        return 7

    assert detection._patiently(record) == 7


def test_a_program_that_ends_does_not_wait_for_changes_db(store):
    detection = ChangeDetection(Config(), store, process=None, model=None)
    detection.hurry.set()

    def record():
        raise StorageFull("changes.db: no space left")

    with pytest.raises(StorageFull):
        detection._patiently(record)


def test_what_an_instance_found_is_stored_as_a_whole_or_not_at_all(store):
    with pytest.raises(StorageFull), store.changes.transaction():
        store.changes.add(make_change())
        raise StorageFull("changes.db: no space left")
    assert store.changes.changes() == []
