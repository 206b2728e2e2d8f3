"""What becomes of a damaged or lost database when the daemon starts again."""

import sqlite3

import numpy as np
import pytest
from stored import SESSION, add_visit, make_change, make_scan

from revisitd.storage.backup import back_up_if_due
from revisitd.storage.errors import DatabaseCorrupt, NewerFormat, StorageFull
from revisitd.storage.store import Store


@pytest.fixture
def data(tmp_path):
    """A directory with two sessions in one map, three scenes, visits, and changes."""
    with Store.open_writer(tmp_path / "data") as store:
        first = store.index.start_session(**SESSION)
        for scene in (1, 2, 3):
            add_visit(store, scene, 1, first, 5, at=(20.0 * scene, 0.0))
        store.index.end_session(first)
        second = store.index.start_session(**SESSION, map_id=first)
        add_visit(store, 1, 2, second, 5, at=(20.0, 1.0))
        store.index.end_session(second)
        store.changes.add(make_change())
    return tmp_path / "data"


def contents(store):
    """All of the index that can be rebuilt, for comparison."""
    index = store.index
    return {
        "sessions": [(row.session_id, row.map_id, row.source, row.config) for row in index.sessions()],
        "scenes": [(row.scene_id, row.map_id, row.hull.tolist(), row.n_visits) for row in index.scenes()],
        "visits": [index.visits(row.scene_id) for row in index.scenes()],
        "scans": [index.scans_of_scene(row.scene_id).scan_id.tolist() for row in index.scenes()],
        "poses": index.trajectory().T_map_sensor.round(9).tolist(),
        "aligned": index.trajectory().aligned.tolist(),
        "descriptors": index.all_descriptors("feedc0ffee00")[1].tolist(),
    }


def damage(path, from_page=1):
    """Noise over all pages from this one on."""
    size = path.stat().st_size
    with open(path, "r+b") as file:
        file.seek(from_page * 4096)
        file.write(np.random.default_rng(0).bytes(size - from_page * 4096))


def delete(path):
    path.unlink()


def empty(path):
    path.write_bytes(b"")


@pytest.mark.parametrize("harm", [damage, lambda path: damage(path, 0), delete, empty], ids=str)
def test_a_damaged_or_lost_index_is_rebuilt_as_it_was(data, harm):
    with Store.open_reader(data) as store:
        before = contents(store)
    harm(data / "index.db")
    with Store.open_writer(data) as store:
        assert contents(store) == before
        assert len(store.repairs) == 1
        assert "rebuilt with 2 sessions, 20 scans, 3 scenes, 4 visits" in store.repairs[0]
        assert "lost: the records of detection instances" in store.repairs[0]
        assert store.index.visits_due() == []
        assert store.index.next_scene_id() == 4
        assert store.new_scan_id() == 21
        assert store.index.start_session(**SESSION) == 3
    with Store.open_writer(data) as store:
        assert store.repairs == []


def test_a_damaged_database_is_kept_under_another_name(data):
    damage(data / "index.db", 0)
    harmed = (data / "index.db").read_bytes()
    Store.open_writer(data).close()
    (kept,) = data.glob("index.db.corrupt-*Z")
    assert kept.read_bytes() == harmed


def test_a_rebuilding_that_was_cut_off_begins_again(data, monkeypatch):
    with Store.open_reader(data) as store:
        before = contents(store)
    (data / "index.db").unlink()

    def full(*_):
        raise StorageFull("no space left")

    monkeypatch.setattr("revisitd.storage.rebuild.replace_durably", full)
    with pytest.raises(StorageFull):
        Store.open_writer(data)
    monkeypatch.undo()
    with Store.open_writer(data) as store:
        assert contents(store) == before
    assert not (data / "index.db.part").exists()


def test_a_damaged_scan_file_is_left_out_of_a_rebuilt_index_and_stays_on_disk(data):
    path = data / "scans" / "1" / "0" / "3.scan"
    path.write_bytes(path.read_bytes()[:-1])
    (data / "index.db").unlink()
    with Store.open_writer(data) as store:
        assert 3 not in store.index.trajectory().scan_id
        assert "1 scans whose files are damaged" in store.repairs[0]
    assert path.exists()


def test_without_the_log_of_places_scans_and_sessions_come_back_from_the_scan_files(data):
    (data / "index.db").unlink()
    (data / "places.jsonl").unlink()
    with Store.open_writer(data) as store:
        assert store.index.trajectory().scan_id.tolist() == list(range(1, 21))
        assert [row.source for row in store.index.sessions()] == ["unknown", "unknown"]


def test_a_torn_or_damaged_line_of_the_log_of_places_costs_that_line_alone(data):
    with Store.open_reader(data) as store:
        before = contents(store)
    log = data / "places.jsonl"
    log.write_bytes(log.read_bytes() + b'0123abcd {"scenes": [{"scene')
    with Store.open_writer(data) as store:
        add_visit(store, 4, 1, store.index.start_session(**SESSION), 2)
    (data / "index.db").unlink()
    with Store.open_writer(data) as store:
        rebuilt = contents(store)
    assert rebuilt["visits"][:3] == before["visits"]
    assert rebuilt["scans"] == [*before["scans"], [21, 22]]


def test_a_killed_writer_leaves_nothing_unsaid_in_the_log_of_places(data):
    with Store.open_writer(data) as store:
        session = store.index.start_session(**SESSION)
        add_visit(store, 4, 1, session, 3)
        store._opened.pop_all()  # as if it had been killed: nothing is closed
        store.dir.close()
    Store.open_writer(data).close()
    (data / "index.db").unlink()
    with Store.open_writer(data) as store:
        assert store.index.scans_of_scene(4).scan_id.tolist() == [21, 22, 23]


def test_damage_that_is_met_in_use_is_mended_at_the_next_start(data, monkeypatch):
    store = Store.open_writer(data)
    damage(data / "index.db")
    with pytest.raises(DatabaseCorrupt, match="index.db: damaged: the next start of the daemon mends it"):
        while True:  # pages that are cached are still good
            store.index.db.rows("SELECT * FROM descriptors")
            store.index.db.write("PRAGMA shrink_memory")
            store.index.add_scan(make_scan(store.new_scan_id()), 1000)
    store.close()
    assert (data / "index.db.suspect").exists()
    monkeypatch.setattr("revisitd.storage.database.CHECK_BUDGET_S", -1.0)  # as if it were too large to be read through
    with Store.open_writer(data) as store:
        assert len(store.repairs) == 1
    assert not (data / "index.db.suspect").exists()


def test_damage_within_a_row_is_met_in_use_and_mended_at_the_next_start(data):
    with Store.open_writer(data) as store:
        back_up_if_due(store.dir, 0.0, kept=1)
    path = data / "changes.db"
    path.write_bytes(path.read_bytes().replace(b'{"n_scans_confirming"', b'{"n_scans\xffconfirming"'))
    with Store.open_writer(data) as store:  # SQLite finds nothing wrong with it
        assert store.repairs == []
        with pytest.raises(DatabaseCorrupt, match="changes.db: damaged"):
            store.changes.changes()
    with Store.open_writer(data) as store:
        assert "restored from changes-" in store.repairs[0]
        assert len(store.changes.changes()) == 1


@pytest.mark.parametrize("harm", [damage, lambda path: damage(path, 0), delete, empty], ids=str)
def test_lost_changes_come_back_from_the_newest_good_backup(data, harm):
    with Store.open_writer(data) as store:
        good = back_up_if_due(store.dir, 0.0, kept=9)
        bad = good.with_name("changes-20990101T000000Z.db")
        bad.write_bytes(good.read_bytes()[:5000])
        lost = store.changes.add(make_change(at=(9.0, 0.0, 0.0)))
    harm(data / "changes.db")
    with Store.open_writer(data) as store:
        (found,) = store.changes.changes()
        assert found.id == 1
        assert f"restored from {good.name}" in store.repairs[0]
        after = store.changes.get(store.changes.add(make_change(at=(9.0, 0.0, 0.0))))
        assert after.id > lost  # a planner may have seen that one
        assert after.revision > 1_700_000_000


def test_lost_changes_without_a_backup_are_said_to_be_lost(data):
    damage(data / "changes.db")
    with Store.open_writer(data) as store:
        assert store.changes.changes() == []
        assert "no good backup: all are lost" in store.repairs[0]
        assert store.changes.add(make_change()) > 1_700_000_000
    assert len(list(data.glob("changes.db.corrupt-*"))) == 1


def test_changes_of_a_newer_version_are_refused_not_moved_aside(data):
    with sqlite3.connect(data / "changes.db") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    with pytest.raises(NewerFormat, match="schema 99"):
        Store.open_writer(data)
    assert list(data.glob("*.corrupt-*")) == []
