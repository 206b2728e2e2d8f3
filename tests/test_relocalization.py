"""Where in an earlier map a scan was taken: found at any heading, and doubted where two poses fit."""

from concurrent.futures import Future

import numpy as np
import pytest
from stored import make_scan, pose

from revisitd.daemon.config import Config
from revisitd.daemon.detection_process import JobFailed
from revisitd.daemon.geometry import inverse, transform
from revisitd.daemon.joining import Joiner
from revisitd.daemon.moments import in_order
from revisitd.daemon.plan import PlacePlan, ScanPlan
from revisitd.daemon.registration import MAX_SCAN_POINTS, MAX_SURFACE_POINTS, scan_cloud, surface_of
from revisitd.daemon.relocalization import COARSE_VOXEL_M, Answer, Place, Verifier, best_guesses, same_pose, verdict

ALIGNMENT = Config().alignment
HALF_X_M, HALF_Y_M, WALL_M, HEIGHT_M = 15.0, 10.0, 4.0, 1.5


def wall(start, end, height=WALL_M):
    """Points (N, 3) of an upright wall, 15 cm apart."""
    along = np.arange(0, np.linalg.norm(np.subtract(end, start)), 0.15)[:, None]
    foot = np.array(start) + along * np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    return np.concatenate([np.column_stack([foot, np.full(len(foot), z)]) for z in np.arange(0, height, 0.15)])


def yard(*things):
    """Points of a walled yard, which looks the same from its other end, and of what else stands in it."""
    corners = [(-HALF_X_M, -HALF_Y_M), (HALF_X_M, -HALF_Y_M), (HALF_X_M, HALF_Y_M), (-HALF_X_M, HALF_Y_M)]
    walls = [wall(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    x, y = np.meshgrid(np.arange(-HALF_X_M, HALF_X_M, 0.2), np.arange(-HALF_Y_M, HALF_Y_M, 0.2))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return np.concatenate([*walls, ground, *things]).astype(np.float32)


def box(x, y, size=3.0, height=2.5):
    corners = [(x, y), (x + size, y), (x + size, y + size), (x, y + size)]
    return np.concatenate([wall(a, b, height) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)])


SHEDS = box(4, 4, 5, 4.0), box(-10, -9, 6, 4.0), wall((-14, 5), (0, 6))
FIRST_DAY = np.stack([pose(x, 0.0, HEIGHT_M, yaw=0.1) for x in np.arange(-3.0, 7.0, 0.5)])  # poses of the stored scans


def located(stored, T_map_sensor, seen=None):
    """The answer for a scan taken at T_map_sensor (4, 4), in a map that holds the points `stored`."""
    place = Place(1, 1, PlacePlan(stored, FIRST_DAY), surface_of(stored, COARSE_VOXEL_M))
    points = transform(inverse(T_map_sensor), stored if seen is None else seen)
    verify = Verifier(points, ALIGNMENT, lambda scene_id: surface_of(stored, ALIGNMENT.voxel_m))
    matches = [verify(guess.T_map_sensor, place) for guess, place in best_guesses(ScanPlan(points), [place])]
    return verdict(1, matches, ALIGNMENT.max_residual_m)


@pytest.mark.parametrize("yaw", [0.0, 1.3, np.pi, -2.0])
def test_a_scan_is_found_at_any_heading_and_two_metres_beside_the_old_path(yaw):
    truth = pose(1.2, 2.0, HEIGHT_M, yaw)
    answer = located(yard(*SHEDS), truth)
    assert answer.reason == ""
    assert same_pose(answer.T_map_sensor, truth, 0.05, 0.5)


def test_a_scan_is_found_among_things_that_came_and_went():
    answer = located(yard(*SHEDS), pose(1.2, 2.0, HEIGHT_M, 1.3), seen=yard(*SHEDS, box(-3, 4, 1.5), box(2, -7, 1.5)))
    assert answer.reason == ""


def test_a_place_that_looks_the_same_from_its_other_end_is_refused():
    answer = located(yard(), pose(1.2, 2.0, HEIGHT_M, 1.3))
    assert "fit at another pose too" in answer.reason


def test_a_twin_beyond_the_old_path_is_known_as_one():
    """The stored scans stood in one half of the yard, the new one in the other."""
    answer = located(yard(), pose(-9.0, -2.0, HEIGHT_M, 2.0))
    assert "fit at another pose too" in answer.reason


def test_another_place_is_not_taken_for_this_one():
    answer = located(yard(*SHEDS), pose(0, 0, HEIGHT_M), seen=np.concatenate([box(-8, -12, 20), box(14, 0, 5)]))
    assert "at best" in answer.reason


def test_a_place_without_anything_upright_is_refused():
    x, y = np.meshgrid(np.arange(-30, 30, 0.3), np.arange(-30, 30, 0.3))
    field = np.column_stack([x.ravel(), y.ravel(), 0.02 * np.sin(x.ravel())]).astype(np.float32)
    assert "nothing stored looks like it" in located(field, pose(0, 0, HEIGHT_M)).reason


def test_clutter_all_around_is_thinned_to_what_can_be_registered_in_time():
    """Rain, leaves or noise in every voxel."""
    clutter = np.random.default_rng(0).uniform(-30, 30, (220_000, 3)).astype(np.float32)
    assert 0.5 * MAX_SCAN_POINTS < scan_cloud(clutter, ALIGNMENT.voxel_m, ALIGNMENT.range_m).size() <= MAX_SCAN_POINTS
    surface = surface_of(clutter, ALIGNMENT.voxel_m)
    assert 0.5 * MAX_SURFACE_POINTS < surface.cloud.size() <= MAX_SURFACE_POINTS


class Asked:
    """Answers from a list; notes the scans it was asked about."""

    def __init__(self, *answers):
        self.answers, self.scan_ids = list(answers), []

    def __call__(self, question):
        self.scan_ids.append(question.scan_id)
        future, answer = Future(), self.answers.pop(0)
        if isinstance(answer, Exception):
            future.set_exception(answer)
        elif answer is not None:  # None: not answered yet
            future.set_result(answer)
        return future


def drive(locate, metres=24.0, wait=True):
    """The join of a session that drives along x, and the key scan (one each metre, from 1) at which it came."""
    joiner = Joiner(locate, [1], ALIGNMENT, wait)
    for k in range(int(metres)):
        join = joiner.update(make_scan(k + 1, T_odom_sensor=pose(float(k))))
        if join is not None:
            return join, k + 1
    return None, None


def at(x, y=100.0, yaw=0.0, map_id=1, reason=""):
    return Answer(map_id, pose(x, y, yaw=yaw), reason)


def test_two_answers_that_agree_five_metres_apart_join_a_session():
    join, scan_id = drive(Asked(at(50.0), at(55.1)))
    assert (join.map_id, scan_id) == (1, 6)
    np.testing.assert_allclose(join.T_map_odom @ pose(5.0), pose(55.1, 100.0), atol=1e-9)


@pytest.mark.parametrize(
    "second",
    [at(55.4), at(55.0, yaw=0.05), at(55.0, map_id=2), at(55.0, reason="doubtful")],
    ids=["elsewhere", "turned", "another map", "doubted"],
)
def test_an_answer_that_no_other_confirms_joins_nothing(second):
    locate = Asked(at(50.0), second, *[at(0.0, reason="doubtful")] * 3)
    assert drive(locate) == (None, None)
    assert locate.scan_ids == [1, 6, 11, 16, 21]


def test_a_question_that_failed_is_asked_again_later(caplog):
    _, scan_id = drive(Asked(JobFailed("it died"), at(55.0), at(60.0)))
    assert scan_id == 11
    assert "it died" in caplog.text


def test_a_live_robot_does_not_wait_for_an_answer():
    assert drive(locate := Asked(None), wait=False) == (None, None)
    assert locate.scan_ids == [1]  # and asks nothing else meanwhile


def test_moments_of_a_clock_that_began_anew_follow_those_before():
    session, stamp_ns = np.array([1, 1, 3, 3, 2]), np.array([500, 700, 100, 150, 700])
    moments = in_order(session, stamp_ns)
    assert (np.diff(moments[[0, 1, 4, 2, 3]]) > 0).all()
    assert moments[3] - moments[2] == 50
    assert (in_order(np.array([1, 1, 2]), np.array([5, 6, 9])) == [5, 6, 9]).all()
