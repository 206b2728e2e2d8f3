"""What a program sees that waits for changes: each new, altered or merged one, once, in order, and exactly."""

import json
import shutil
import sqlite3
import subprocess
import sys
import threading
import time

import pytest
from click.testing import CliRunner
from stored import make_change

from revisitd.daemon.cli import cli
from revisitd.storage.changerows import MergedChange, Observation
from revisitd.storage.changes import ChangeStore
from revisitd.storage.schema import CHANGES_V1, CHANGES_V2
from revisitd.storage.store import Store

GONE = Observation("gone", session=1, scene=1, visit=3, time_ns=5)


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        yield store


def entries(store, since=0):
    return [(entry.id, isinstance(entry, MergedChange)) for entry in store.changes.since(since)]


def last_revision(store):
    return store.changes.since(0)[-1].revision


def test_new_changes_come_in_the_order_of_their_commits(store):
    ids = [store.changes.add(make_change(at=(i, 0.0, 0.0))) for i in range(5)]
    assert entries(store) == [(i, False) for i in ids]
    assert entries(store, last_revision(store)) == []


def test_an_altered_change_comes_again_as_it_is_now(store):
    first, second = (store.changes.add(make_change(at=(x, 0.0, 0.0))) for x in (0.0, 5.0))
    seen = last_revision(store)
    store.changes.observe(first, GONE, superseded_by=second)
    (entry,) = store.changes.since(seen)
    assert (entry.id, entry.state, entry.superseded_by) == (first, "ended", second)


def test_a_merged_change_is_seen_to_go_and_what_it_altered_to_change(store):
    whole, part, ended = (store.changes.add(make_change(at=(x, 0.0, 0.0))) for x in (0.0, 5.0, 9.0))
    store.changes.observe(ended, GONE, superseded_by=part)
    seen = last_revision(store)
    store.changes.merge(part, whole)
    assert sorted(entries(store, seen)) == [(whole, False), (part, True), (ended, False)]
    assert store.changes.get(ended).superseded_by == whole


def test_a_reader_that_applies_the_feed_holds_what_the_store_holds(store):
    copy, revision = {}, 0
    with Store.open_reader(store.dir.path) as reader:
        for step in range(60):
            known = [change.id for change in store.changes.changes(with_points=False)]
            if step % 7 == 6:
                store.changes.merge(known[-1], known[0])
            elif step % 5 == 4:
                store.changes.observe(known[step % len(known)], GONE)
            else:
                store.changes.add(make_change(at=(step, 0.0, 0.0)))
            if step % 3 == 0:
                for entry in reader.changes.since(revision):
                    revision = entry.revision
                    if isinstance(entry, MergedChange):
                        copy.pop(entry.id, None)
                    else:
                        copy[entry.id] = (entry.state, entry.n_points, entry.revision)
                now = reader.changes.changes(with_points=False)
                assert copy == {change.id: (change.state, change.n_points, change.revision) for change in now}


def test_the_view_for_other_programs_is_the_same_feed(store):
    whole, part = (store.changes.add(make_change(at=(x, 0.0, 0.0))) for x in (0.0, 5.0))
    store.changes.merge(part, whole)
    with sqlite3.connect(f"file:{store.dir.changes_path}?mode=ro", uri=True) as other:
        rows = other.execute("SELECT revision, event, id, merged_into FROM change_feed ORDER BY revision").fetchall()
    other.close()
    assert [row[1:] for row in rows] == [("changed", whole, None), ("merged", part, whole)]
    assert [row[0] for row in rows] == [entry.revision for entry in store.changes.since(0)]


def test_a_store_of_an_earlier_version_goes_on_with_higher_revisions(tmp_path):
    path = tmp_path / "changes.db"
    old = sqlite3.connect(path)
    old.executescript(f"{CHANGES_V1}; {CHANGES_V2}; PRAGMA user_version = 2;")
    old.execute("INSERT INTO store VALUES (1, 'u', 0)")
    columns = """id, revision, polarity, map_id, session_id, scene_id, visit, first_seen_ns, first_seen_host_ns,
        x, y, z, min_x, min_y, min_z, max_x, max_y, max_z, n_points, points, confidence, evidence, model_id,
        config_digest, detected_host_ns, updated_host_ns"""
    values = (1, 17, "appeared", *[1] * 6, *[0.0] * 9, 1, bytes(12), 0.5, "{}", "m", "c", 1, 1)
    old.execute(f"INSERT INTO changes ({columns}) VALUES ({', '.join('?' * len(values))})", values)
    old.executemany("INSERT INTO merged_changes VALUES (?, 1, 0)", [(5,), (9,)])
    old.commit()
    old.close()
    store = ChangeStore.open_writer(path, "u")
    assert [(entry.revision, entry.id) for entry in store.since(0)] == [(17, 1), (18, 5), (19, 9)]
    store.add(make_change())
    assert store.since(0)[-1].revision == 20
    store.close()


# The command --------------------------------------------------------------------------------------------------------


def lines_since(data, revision):
    result = CliRunner().invoke(cli, ["changes", "--data", str(data), "--since", str(revision)])
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.output.splitlines()]


def test_the_command_prints_a_line_for_each_entry_since_a_revision(store):
    whole, part = (store.changes.add(make_change(at=(x, 0.0, 0.0))) for x in (0.0, 5.0))
    first = lines_since(store.dir.path, 0)
    assert [(line["event"], line["id"], line["state"]) for line in first] == [
        ("changed", whole, "present"),
        ("changed", part, "present"),
    ]
    store.changes.merge(part, whole)
    changed, merged = lines_since(store.dir.path, first[-1]["revision"])
    assert (changed["id"], changed["n_points"]) == (whole, 100)
    assert merged == {"revision": merged["revision"], "event": "merged", "id": part, "into": whole}
    assert lines_since(store.dir.path, merged["revision"]) == []


def test_a_follower_gets_each_line_as_it_is_committed_also_from_a_restored_file(store):
    program = [sys.executable, "-c", "from revisitd.daemon.cli import main; main()"]
    command = [*program, "changes", "--data", str(store.dir.path), "--follow"]
    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as follower:
        reading = threading.Thread(target=lambda: lines.extend(json.loads(line) for line in follower.stdout))
        reading.start()

        def wait_for(n):
            deadline = time.monotonic() + 30.0
            while len(lines) < n and time.monotonic() < deadline:
                time.sleep(0.02)

        store.changes.add(make_change())
        wait_for(1)
        path = store.dir.changes_path
        store.close()
        shutil.copyfile(path, path.with_name("restored"))
        path.with_name("restored").replace(path)
        with Store.open_writer(path.parent) as again:
            again.changes.add(make_change(at=(5.0, 0.0, 0.0)))
            wait_for(2)
        follower.terminate()
        reading.join()
    assert [line["id"] for line in lines] == [1, 2]
