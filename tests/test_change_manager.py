"""The change manager: each physical change one object with a history, and removed things erased from the map."""

from dataclasses import replace

import numpy as np
import pytest

from revisitd.daemon.changes import ChangeManager, Finding
from revisitd.daemon.detection.erasure import update_map
from revisitd.daemon.detection.results import DetectedObject, KnownState
from revisitd.daemon.detection.submap import Submap
from revisitd.daemon.worker import Instance
from revisitd.storage.store import Store

S = 1_000_000_000


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as opened:
        yield opened.changes


def block(x, y, size=0.5, z=0.0):
    """Points of a cube's surface, 5 cm apart."""
    steps = np.arange(0, size, 0.05)
    grid = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    shell = (grid == 0).any(axis=1) | (grid == steps[-1]).any(axis=1)
    return (grid[shell] + [x + 0.02, y + 0.02, z + 0.02]).astype(np.float32)


def found(polarity, points, before_s, after_s):
    return DetectedObject(polarity, points, before_s * S, after_s * S, len(points), 5, 5, 0.4)


def finding(visit, scene=1, session=1, before_session=1):
    return Finding(1, session, scene, visit, 0, before_session, 0.03, "model", "config")


def test_the_same_change_seen_from_a_neighbouring_scene_is_one_object_completed(store):
    manager, bag = ChangeManager(store), block(3, 4)
    assert manager.record(found("appeared", bag[: len(bag) * 2 // 3], 10, 60), finding(2, scene=1))
    assert not manager.record(found("appeared", bag[len(bag) // 3 :], 12, 65), finding(2, scene=2))
    (change,) = store.changes()
    assert change.n_points == len(bag)
    assert [event["kind"] for event in store.history(change.id)] == ["appeared", "still"]


def test_a_change_that_still_holds_on_a_later_visit_is_not_reported_again(store):
    manager, bag = ChangeManager(store), block(3, 4)
    manager.record(found("appeared", bag, 10, 60), finding(2))
    assert not manager.record(found("appeared", bag, 10, 160), finding(3))
    assert len(store.changes()) == 1


def test_what_comes_goes_and_comes_again_is_three_changes(store):
    manager, bag = ChangeManager(store), block(3, 4)
    assert manager.record(found("appeared", bag, 10, 60), finding(2))
    assert manager.record(found("disappeared", bag, 70, 160), finding(3))
    assert manager.record(found("appeared", bag, 170, 260), finding(4))
    first, second, third = store.changes()
    assert (first.state, second.state, third.state) == ("ended", "ended", "present")
    assert (first.superseded_by, second.superseded_by) == (second.id, third.id)


def test_a_door_that_opens_is_two_changes_and_neither_ends_the_other(store):
    manager = ChangeManager(store)
    manager.record(found("appeared", block(3.0, 4.3), 10, 60), finding(2))
    manager.record(found("disappeared", block(3.0, 4.0), 20, 61), finding(2))
    assert [change.state for change in store.changes()] == ["present", "present"]


def test_neighbours_that_hardly_touch_stay_two(store):
    manager = ChangeManager(store)
    manager.record(found("appeared", block(0, 0, size=1.0), 10, 60), finding(2))
    assert manager.record(found("appeared", block(1.35, 0.8, size=1.0), 70, 120), finding(3))


def test_two_ends_of_a_car_are_one_once_a_third_view_joins_them(store):
    manager = ChangeManager(store)
    manager.record(found("appeared", block(0, 0, size=1.0), 10, 60), finding(2))
    assert manager.record(found("appeared", block(3, 0, size=1.0), 10, 62), finding(2))
    assert not manager.record(found("appeared", block(1.3, 0, size=1.5), 10, 64), finding(2))
    (whole,) = store.changes()
    assert store.whole_of(2) == store.whole_of(1) == whole.id
    visit = Instance(session_id=1, map_id=1, scene_id=1, visit_id=2, visit=2, t_in_ns=50 * S, t_out_ns=70 * S)
    manager.note([KnownState(2, 1.0, 0.0)], visit)  # asked before it merged
    assert [row["kind"] for row in store.history(whole.id)] == ["appeared", "appeared", "still"]
    np.testing.assert_allclose([whole.box_min[0], whole.box_max[0]], [0, 4], atol=0.1)


BOX = np.array([-50.0, -50.0, -5.0]), np.array([50.0, 50.0, 5.0])


def seen_at(stamps_s, session=1):
    """A submap of scans that each saw the bag at (3, 4) and a wall at (6, 4): it, and the scans' sessions."""
    shot = np.vstack([block(3, 4), block(6, 4, size=1.0)])
    scan = np.repeat(np.arange(len(stamps_s), dtype=np.int16), len(shot))
    stamps = np.array(stamps_s) * S
    submap = Submap(np.vstack([shot] * len(stamps_s)), scan, [], np.ones(len(stamps_s)), stamps)
    return submap, np.full(len(stamps_s), session)


def test_a_removed_object_is_erased_from_older_scans_only(store):
    manager, bag, wall = ChangeManager(store), block(3, 4), block(6, 4, size=1.0)
    manager.record(found("disappeared", bag, 50, 60), finding(2))
    submap = update_map(*seen_at([20, 80]), manager.erasures(1, BOX, (1, 100 * S)))
    assert np.bincount(submap.scan).tolist() == [len(wall), len(bag) + len(wall)]


def test_planners_bring_points_of_their_own_up_to_date(store):
    manager, bag, wall = ChangeManager(store), block(3, 4), block(6, 4, size=1.0)
    manager.record(found("disappeared", bag, 50, 60), finding(2))
    points = np.vstack([bag, bag, wall])
    taken = np.repeat([[1, 20 * S], [1, 80 * S], [1, 20 * S]], [len(bag), len(bag), len(wall)], axis=0)
    stands = manager.update_map(points, taken, 1, (1, 100 * S))
    assert not stands[: len(bag)].any()
    assert stands[len(bag) :].all()


def test_what_was_not_yet_known_at_the_time_is_not_erased(store):
    manager, bag, wall = ChangeManager(store), block(3, 4), block(6, 4, size=1.0)
    manager.record(found("disappeared", bag, 50, 60), finding(2))
    assert len(update_map(*seen_at([20]), manager.erasures(1, BOX, (1, 55 * S))).points) == len(bag) + len(wall)
    # A later session, whose clock began anew.
    assert len(update_map(*seen_at([20]), manager.erasures(1, BOX, (2, 5 * S))).points) == len(wall)


def test_planners_get_the_list_without_points_above_a_size(store):
    manager = ChangeManager(store)
    manager.record(found("appeared", block(0, 0), 10, 60), finding(2))
    manager.record(found("appeared", block(5, 0, size=0.2), 10, 60), finding(2))
    assert len(manager.publish_change_list(0)) == 2
    (large,) = manager.publish_change_list(100)
    assert large.points is None and large.n_points > 100


def test_more_scans_that_agree_give_more_confidence(store):
    manager = ChangeManager(store)
    strong = found("appeared", block(0, 0), 10, 60)
    manager.record(strong, finding(2))
    manager.record(replace(strong, points=block(5, 0), n_confirming=2, n_seen_by=3), finding(2))
    strong, weak = store.changes()
    assert weak.confidence < strong.confidence
