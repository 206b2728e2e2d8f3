"""What the index promises to the pipeline and to the detection."""

import sqlite3
import threading

import numpy as np
import pytest
from stored import SESSION, make_scan, pose

from revisitd.storage.errors import StorageReadOnly
from revisitd.storage.index import IndexStore
from revisitd.storage.rows import InstanceRow
from revisitd.storage.schema import CHANGES_MIGRATIONS, INDEX_MIGRATIONS

UUID = "00000000-0000-0000-0000-000000000001"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "index.db"


@pytest.fixture
def index(path):
    index = IndexStore.open_writer(path, UUID)
    yield index
    index.close()


@pytest.fixture
def session(index):
    return index.start_session(**SESSION)


def add_visit(index, scene, number, session, scan_ids):
    with index.transaction():
        visit = index.open_visit(scene, number, session, scan_ids[0])
        for scan_id in scan_ids:
            index.add_scan(make_scan(scan_id, session), 1000)
        index.add_visit_scans(visit, scan_ids)
        index.close_visit(visit, scan_ids[-1])
    return visit


def test_a_session_makes_its_own_map_or_joins_an_older_one(index):
    first = index.start_session(**SESSION)
    second = index.start_session(**SESSION, map_id=first)
    third = index.start_session(**SESSION)
    assert [(row.session_id, row.map_id) for row in index.sessions()] == [(1, first), (second, first), (third, third)]
    assert index.sessions()[0].config == SESSION["config"]


def test_a_session_of_an_unknown_map_is_refused(index):
    with pytest.raises(sqlite3.IntegrityError):
        index.start_session(**SESSION, map_id=17)
    assert index.sessions() == []


def test_poses_and_times_come_back(index, session):
    scans = [make_scan(i, session, T_map_sensor=pose(i, -i, 0.5, yaw=0.3 * i)) for i in range(1, 20)]
    for scan in scans:
        index.add_scan(scan, 1000)
    trajectory = index.trajectory()
    assert trajectory.scan_id.tolist() == list(range(1, 20))
    assert trajectory.stamp_ns.tolist() == [scan.stamp_ns for scan in scans]
    np.testing.assert_allclose(trajectory.T_map_sensor, [scan.T_map_sensor for scan in scans], atol=1e-12)


def test_a_trajectory_may_be_asked_for_one_session(index, session):
    index.add_scan(make_scan(1, session), 1000)
    other = index.start_session(**SESSION)
    index.add_scan(make_scan(2, other), 1000)
    assert index.trajectory(other).scan_id.tolist() == [2]
    assert index.trajectory().session.tolist() == [session, other]


def test_an_empty_index_answers_with_empty_arrays(index):
    assert index.trajectory().T_map_sensor.shape == (0, 4, 4)
    assert index.scans_of_scene(1).descriptors.shape[0] == 0
    assert index.all_descriptors("feedc0ffee00")[1].shape[0] == 0
    assert index.scenes() == []
    assert index.next_scan_id() == index.next_scene_id() == 1


def test_the_scans_of_earlier_visits_and_of_one_visit_are_told_apart(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    index.add_scene(2, session, np.array([[9.0, 0.0]]), 2.5, 20.0)
    add_visit(index, 1, 1, session, [1, 2, 3])
    add_visit(index, 2, 1, session, [4])
    add_visit(index, 1, 2, session, [5, 6])
    add_visit(index, 1, 3, session, [7])
    assert index.scans_of_scene(1, before_visit=3).scan_id.tolist() == [1, 2, 3, 5, 6]
    assert index.scans_of_scene(1, visit=3).scan_id.tolist() == [7]
    scans = index.scans_of_scene(1)
    assert scans.visit_number.tolist() == [1, 1, 1, 2, 2, 3]
    assert set(scans.model_id) == {"feedc0ffee00"}
    np.testing.assert_array_equal(scans.descriptors, [make_scan(i).descriptor for i in scans.scan_id])


def test_rows_may_be_chosen_from_the_scans_of_a_scene(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    add_visit(index, 1, 1, session, [1, 2, 3])
    scans = index.scans_of_scene(1)
    chosen = scans.only(scans.scan_id != 2)
    assert chosen.scan_id.tolist() == [1, 3]
    np.testing.assert_array_equal(chosen.descriptors, scans.descriptors[[0, 2]])
    assert scans.only(np.array([2, 0])).scan_id.tolist() == [3, 1]


def test_a_scan_may_belong_to_visits_of_several_scenes(index, session):
    for scene in (1, 2):
        index.add_scene(scene, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    visits = [index.open_visit(scene, 1, session, 0) for scene in (1, 2)]
    index.add_scan(make_scan(1, session), 1000)
    for visit in visits:
        index.add_visit_scans(visit, [1])
    assert [index.scans_of_scene(scene).scan_id.tolist() for scene in (1, 2)] == [[1], [1]]


def test_scenes_come_back_with_hull_and_number_of_visits(index, session):
    hull = np.array([[0.0, 0.1], [10.0, 0.2], [5.0, 1 / 3]])
    index.add_scene(1, session, hull, 2.5, 77.5)
    add_visit(index, 1, 1, session, [1])
    add_visit(index, 1, 2, session, [2])
    (scene,) = index.scenes(map_id=session)
    np.testing.assert_array_equal(scene.hull, hull)
    assert (scene.scene_id, scene.margin_m, scene.area_m2, scene.n_visits) == (1, 2.5, 77.5, 2)
    assert index.scenes(map_id=99) == []
    assert index.next_scene_id() == 2


def test_a_map_that_was_given_up_for_an_older_one_is_not_joined_again(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    alone = index.start_session(**SESSION)
    assert index.maps_to_join() == [session]  # what has no scene is no map to come back to
    index.add_scene(2, alone, np.array([[0.0, 0.0]]), 2.5, 20.0)
    assert index.maps_to_join() == [session, alone]
    joined = index.start_session(**SESSION, map_id=session, continues=alone)
    assert index.maps_to_join() == [session]
    assert [row.continues for row in index.sessions()] == [None, None, alone]
    assert index.sessions()[-1].session_id == joined


def test_descriptors_come_with_the_scenes_of_their_scans(index, session):
    other = index.start_session(**SESSION)
    for scene, map_id, scan_ids in ((1, session, [1, 2]), (2, other, [3])):
        index.add_scene(scene, map_id, np.array([[0.0, 0.0]]), 2.5, 20.0)
        add_visit(index, scene, 1, map_id, scan_ids)
    scene, descriptors = index.scene_descriptors("feedc0ffee00", [session, other])
    assert scene.tolist() == [1, 1, 2]
    np.testing.assert_array_equal(descriptors, [make_scan(i).descriptor for i in (1, 2, 3)])
    assert index.scene_descriptors("feedc0ffee00", [other])[0].tolist() == [2]
    assert len(index.scene_descriptors("another model", [session, other])[0]) == 0


def test_two_visits_of_a_scene_cannot_have_the_same_number(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    index.open_visit(1, 1, session, 0)
    with pytest.raises(sqlite3.IntegrityError):
        index.open_visit(1, 1, session, 5)


def test_a_visit_is_open_until_it_is_closed(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    visit = index.open_visit(1, 1, session, 100)
    assert index.visits(1)[0].t_out_ns is None
    index.close_visit(visit, 200)
    assert index.visits(1)[0].t_out_ns == 200


def test_visits_that_a_killed_process_left_open_end_with_their_last_scan(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    visit = index.open_visit(1, 1, session, 100)
    scan = make_scan(1, session)
    index.add_scan(scan, 1000)
    index.add_visit_scans(visit, [1])
    index.start_session(**SESSION)
    assert index.visits(1)[0].t_out_ns == scan.stamp_ns


def test_descriptors_of_another_model_are_left_out(index, session):
    index.add_scan(make_scan(1, session), 1000)
    index.add_scan(make_scan(2, session, model_id="another"), 1000)
    ids, descriptors = index.all_descriptors("another")
    assert ids.tolist() == [2]
    np.testing.assert_array_equal(descriptors, [make_scan(2).descriptor])


def test_a_scan_and_its_place_in_a_visit_are_there_both_or_not_at_all(index, session):
    with pytest.raises(sqlite3.IntegrityError), index.transaction():
        index.add_scan(make_scan(1, session), 1000)
        index.add_visit_scans(99, [1])
    assert index.counts()["scans"] == 0


def test_an_error_in_one_thread_does_not_undo_what_another_wrote(index, session):
    inside, go_on = threading.Event(), threading.Event()

    def fail():
        with pytest.raises(RuntimeError), index.transaction():
            index.add_scan(make_scan(1, session), 1000)
            inside.set()
            go_on.wait(10)
            raise RuntimeError

    failing = threading.Thread(target=fail)
    failing.start()
    inside.wait(10)
    writing = threading.Thread(target=index.add_scan, args=(make_scan(2, session), 1000))
    writing.start()
    go_on.set()
    failing.join()
    writing.join()
    assert index.trajectory().scan_id.tolist() == [2]


def test_how_an_instance_went_is_recorded(index, session):
    index.add_scene(1, session, np.array([[0.0, 0.0]]), 2.5, 20.0)
    visit = add_visit(index, 1, 1, session, [1])
    index.record_instance(InstanceRow(1, visit, "done", seconds=1.5, stage_seconds={"load": 0.5}, n_changes=2))
    index.record_instance(InstanceRow(1, visit, "rejected", "alignment residual 0.31 m"))
    counts = index.counts()
    assert (counts["instances_done"], counts["instances_rejected"], counts["instances_dropped"]) == (1, 1, 0)
    with pytest.raises(sqlite3.IntegrityError):
        index.record_instance(InstanceRow(1, visit, "perhaps"))


@pytest.mark.parametrize("migrations", [INDEX_MIGRATIONS, CHANGES_MIGRATIONS])
def test_every_table_refuses_values_of_another_type(migrations):
    connection = sqlite3.connect(":memory:")
    for script in migrations:
        connection.executescript(script)
    tables = connection.execute(
        "SELECT name, strict FROM pragma_table_list WHERE type = 'table' AND name NOT LIKE 'sqlite_%'"
    ).fetchall()
    connection.close()
    assert len(tables) >= 3
    assert [name for name, strict in tables if not strict] == []


@pytest.mark.parametrize("version", range(1, len(INDEX_MIGRATIONS) + 1))
def test_an_index_of_every_past_version_opens(path, version):
    connection = sqlite3.connect(path)
    for script in INDEX_MIGRATIONS[:version]:
        connection.executescript(script)
    connection.execute(f"PRAGMA user_version = {version}")
    connection.close()
    index = IndexStore.open_writer(path, UUID)
    assert index.counts()["scans"] == 0
    index.close()


def test_a_reader_cannot_write(index, session, path):
    reader = IndexStore.open_reader(path)
    with pytest.raises(StorageReadOnly, match="read-only"):
        reader.start_session(**SESSION)
    reader.close()


def test_a_visit_is_due_until_it_is_known_how_its_instance_went(index, session):
    index.add_scene(1, session, np.zeros((3, 2)), 2.5, 20.0)
    add_visit(index, 1, 1, session, [1, 2])
    second, third = (add_visit(index, 1, number, session, [2 * number, 2 * number + 1]) for number in (2, 3))
    open_still = index.open_visit(1, 4, session, 10)
    assert [(row.visit_id, row.visit, row.map_id) for row in index.visits_due()] == [(second, 2, 1), (third, 3, 1)]
    index.record_instance(InstanceRow(1, second, "rejected", "not aligned"))
    assert [row.visit_id for row in index.visits_due()] == [third]
    index.close_visit(open_still, 12)
    assert [row.visit_id for row in index.visits_due()] == [third, open_still]
