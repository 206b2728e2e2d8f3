"""What changes.db promises to planners and to the change manager."""

import sqlite3
import threading

import numpy as np
import pytest
from stored import make_change

from revisitd.storage.changerows import Observation
from revisitd.storage.changes import ChangeStore
from revisitd.storage.errors import StorageError
from revisitd.storage.schema import CHANGES_MIGRATIONS

UUID = "00000000-0000-0000-0000-000000000001"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "changes.db"


@pytest.fixture
def store(path):
    store = ChangeStore.open_writer(path, UUID)
    yield store
    store.close()


def test_a_change_comes_back_as_it_was_found(store):
    change = make_change(at=(3.0, -2.0, 0.5), last_before_session=1, last_before_ns=7)
    found = store.get(store.add(change))
    np.testing.assert_array_equal(found.points, change.points)
    for name in set(vars(change)) - {"points"}:
        assert getattr(found, name) == getattr(change, name), name
    assert found.state == "present"


def test_centroid_box_and_number_follow_from_the_points(store):
    change = make_change(at=(3.0, -2.0, 0.5), n_points=200)
    found = store.get(store.add(change))
    np.testing.assert_allclose(found.centroid, change.points.mean(axis=0, dtype=np.float64))
    np.testing.assert_array_equal(found.box_min, change.points.min(axis=0))
    np.testing.assert_array_equal(found.box_max, change.points.max(axis=0))
    assert found.n_points == 200


def test_points_are_plain_float32_for_other_programs(store, path):
    change = make_change()
    store.add(change)
    with sqlite3.connect(path) as connection:
        (blob,) = connection.execute("SELECT points FROM changes").fetchone()
    connection.close()
    np.testing.assert_array_equal(np.frombuffer(blob, "<f4").reshape(-1, 3), change.points)


def test_a_change_keeps_one_point_in_each_five_centimetres(store):
    crowded = np.repeat(make_change(n_points=20).points, 30, axis=0)
    assert store.get(store.add(make_change(points=crowded))).n_points == 20


def test_a_change_without_points_is_refused(store):
    with pytest.raises(StorageError, match="without points"):
        store.add(make_change(points=np.empty((0, 3), np.float32)))


def test_ids_grow_and_are_never_used_again(store, path):
    assert [store.add(make_change()) for _ in range(3)] == [1, 2, 3]
    with sqlite3.connect(path) as connection:
        connection.execute("DELETE FROM observations")
        connection.execute("DELETE FROM changes")
    connection.close()
    assert store.add(make_change()) == 4


def test_the_same_object_from_a_neighbouring_scan_adds_its_points_and_changes_none(store):
    whole = make_change(n_points=300).points
    change_id = store.add(make_change(points=whole[:200]))
    store.extend(change_id, whole[150:], 0.9, {"n_scans_seen": 6})
    found = store.get(change_id)
    np.testing.assert_array_equal(found.points, whole)
    assert found.n_points == 300
    assert (found.confidence, found.evidence) == (0.9, {"n_scans_seen": 6})
    np.testing.assert_allclose(found.centroid, whole.mean(axis=0, dtype=np.float64))


@pytest.mark.parametrize("call", ["get", "extend", "observe"])
def test_a_change_that_is_not_there_is_named(store, call):
    with pytest.raises(StorageError, match="no change 17"):
        if call == "get":
            store.get(17)
        elif call == "extend":
            store.extend(17, make_change().points, 0.5, {})
        else:
            store.observe(17, Observation("still", session=1, scene=1, visit=3, time_ns=5))


def test_a_change_has_a_history(store):
    change_id = store.add(make_change(first_seen_ns=10))
    store.observe(change_id, Observation("still", session=1, scene=1, visit=3, time_ns=20))
    assert store.get(change_id).state == "present"
    reverse = store.add(make_change("disappeared", visit=4))
    store.observe(change_id, Observation("gone", session=1, scene=1, visit=4, time_ns=30), superseded_by=reverse)
    found = store.get(change_id)
    assert (found.state, found.superseded_by) == ("ended", reverse)
    assert [(row["kind"], row["visit"], row["time_ns"]) for row in store.history(change_id)] == [
        ("appeared", 2, 10),
        ("still", 3, 20),
        ("gone", 4, 30),
    ]


def test_everything_new_or_altered_has_a_higher_revision(store):
    first, second = store.add(make_change()), store.add(make_change())
    store.extend(first, make_change(at=(1, 0, 0)).points, 0.5, {})
    store.observe(second, Observation("still", session=1, scene=1, visit=3, time_ns=20))
    assert [store.get(change_id).revision for change_id in (first, second)] == [3, 4]


def test_a_planner_gets_the_metadata_of_all_changes_of_at_least_n_points(store):
    for n_points in (30, 100, 125, 400):
        store.add(make_change(n_points=n_points))
    published = store.publish_change_list(125)
    assert [change.n_points for change in published] == [125, 400]
    assert all(change.points is None for change in published)


def test_negative_changes_of_a_place_before_a_moment_are_found_in_order(store):
    box = (np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0]))
    late = store.add(make_change("disappeared", first_seen_ns=300))
    early = store.add(make_change("disappeared", first_seen_ns=100))
    store.add(make_change("disappeared", first_seen_ns=100, at=(5.0, 0.0, 0.0)))
    store.add(make_change("appeared", first_seen_ns=100))
    store.add(make_change("disappeared", first_seen_ns=100, map_id=2))

    def found(before):
        return [change.id for change in store.changes(polarity="disappeared", map_id=1, box=box, before=before)]

    assert found((1, 300)) == [early]
    assert found((1, 301)) == [early, late]
    assert found((2, 0)) == [early, late], "the sensor's clock may start anew: a later session is later"


def test_a_box_that_touches_a_change_finds_it(store):
    change_id = store.add(make_change(at=(10.0, 0.0, 0.0), n_points=1000))
    touching = (np.array([10.4, -0.1, -0.1]), np.array([12.0, 0.1, 0.1]))
    beside = (np.array([10.5, -0.1, -0.1]), np.array([12.0, 0.1, 0.1]))
    assert [change.id for change in store.changes(box=touching)] == [change_id]
    assert store.changes(box=beside) == []


def test_views_read_well_for_people(store, path):
    store.add(make_change(at=(3.0, -2.0, 0.5), n_points=1000))
    with sqlite3.connect(path) as connection:
        connection.row_factory = sqlite3.Row
        (row,) = connection.execute("SELECT * FROM change_list").fetchall()
        assert (row["id"], row["polarity"], row["x"], row["y"], row["z"]) == (1, "appeared", 3.0, -2.0, 0.5)
        assert row["first_seen_utc"] == "2025-10-09 08:53:20"
        assert row["height"] == 0.9
        assert len(connection.execute("SELECT * FROM present_changes").fetchall()) == 1
        assert connection.execute("SELECT seen_as FROM change_history").fetchone()[0] == "appeared"
    connection.close()


def test_only_known_polarities_are_stored(store):
    with pytest.raises(sqlite3.IntegrityError):
        store.add(make_change("moved"))
    assert store.changes() == []


def test_readers_see_whole_changes_while_they_are_written(store, path):
    failures, stop = [], threading.Event()

    def read():
        reader = ChangeStore.open_reader(path)
        seen = 0
        while not stop.is_set():
            changes = reader.changes()
            if len(changes) < seen or any(len(reader.history(c.id)) != 1 for c in changes[-3:]):
                failures.append(len(changes))
            seen = len(changes)
        reader.close()

    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    for _ in range(60):
        store.add(make_change(n_points=30))
    stop.set()
    for reader in readers:
        reader.join()
    assert failures == []
    assert len(store.changes()) == 60


def test_after_the_writer_has_gone_the_file_alone_holds_everything(path, tmp_path):
    store = ChangeStore.open_writer(path, UUID)
    store.add(make_change())
    store.close()
    copy = tmp_path / "copy.db"
    copy.write_bytes(path.read_bytes())
    reader = ChangeStore.open_reader(copy)
    assert len(reader.changes()) == 1
    reader.close()


def test_readers_who_may_not_write_to_the_directory_find_what_they_need(path):
    ChangeStore.open_writer(path, UUID).close()
    beside = {entry.name for entry in path.parent.iterdir()}
    assert {"changes.db-wal", "changes.db-shm"} <= beside, "SQLite cannot open the file read-only without them"
    ChangeStore.open_reader(path).close()
    assert {entry.name for entry in path.parent.iterdir()} == beside


def test_a_writer_closes_although_a_reader_is_in_the_middle_of_reading(path):
    store = ChangeStore.open_writer(path, UUID)
    store.add(make_change())
    reader = sqlite3.connect(path, isolation_level=None)
    reader.execute("BEGIN")
    assert reader.execute("SELECT count(*) FROM changes").fetchone() == (1,)
    store.add(make_change())
    store.close()
    assert reader.execute("SELECT count(*) FROM changes").fetchone() == (1,)
    reader.execute("COMMIT")
    assert reader.execute("SELECT count(*) FROM changes").fetchone() == (2,)
    reader.close()


@pytest.mark.parametrize("version", range(1, len(CHANGES_MIGRATIONS) + 1))
def test_changes_of_every_past_version_open(path, version):
    connection = sqlite3.connect(path)
    for script in CHANGES_MIGRATIONS[:version]:
        connection.executescript(script)
    connection.execute(f"PRAGMA user_version = {version}")
    connection.close()
    store = ChangeStore.open_writer(path, UUID)
    assert store.changes() == []
    store.close()
