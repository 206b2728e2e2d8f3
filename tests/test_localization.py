"""A key scan finds its place in a known scene, whatever the odometry says, or says why not."""

import numpy as np
import pytest
import yard
from scipy.spatial.transform import Rotation

from revisitd.daemon.config import Config
from revisitd.daemon.localization import CACHED_REFERENCES, Localizer
from revisitd.daemon.odometry import Health, Motion
from revisitd.daemon.scenes import Scene
from revisitd.daemon.sweep import summed_up

SCENE = Scene(1, np.zeros((1, 2)))


def surface(seed, changed=False):
    """(N, 3) float32: the yard and a hut in it, map frame; changed: a car has come and the hut is gone."""
    rng = np.random.default_rng(seed)

    def wall(x, y, z, n):
        return np.column_stack([rng.uniform(*axis, n) for axis in (x, y, z)])

    x, y, z = (-yard.HALF_X_M, yard.HALF_X_M), (-yard.HALF_Y_M, yard.HALF_Y_M), (0.0, yard.WALL_M)
    parts = [wall((s, s), y, z, 30_000) for s in x] + [wall(x, (s, s), z, 30_000) for s in y]
    parts.append(wall(x, y, (0.0, 0.0), 60_000))
    box = ((4, 8), (3, 5), (0, 1.5)) if changed else ((-6, -4), (-5, -3), (0, 2.5))
    for axis in range(2):
        for side in box[axis]:
            sides = [box[0], box[1], box[2]]
            sides[axis] = (side, side)
            parts.append(wall(*sides, 5000))
    points = np.vstack(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))
    # Shifted, so that no surface lies between two voxels.
    return (points + [0.1, 0.2, 0.15]).astype(np.float32)


def seen_from(pose, points):
    """A scan of points (N, 3), map frame, by a sensor that stands."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    phase = np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) + 0.5
    return summed_up(local, phase, Config().alignment.cell_m)


def first_visit(scene):
    """The cells of the scans of the scene's first visit: two, of half the surface each."""
    points = surface(0)
    for half in (points[::2], points[1::2]):
        yield seen_from(np.eye(4), half).in_map(np.eye(4), np.eye(4))


def localizer():
    return Localizer(Config().alignment, first_visit, np.eye(4))


def motion(T_odom_sensor):
    return Motion(T_odom_sensor, np.eye(4), Health.GOOD)


def error_of(fix, pose):
    error = np.linalg.inv(pose) @ fix.T_map_sensor
    return np.linalg.norm(error[:3, 3]), np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude())


@pytest.mark.parametrize("off_m", [0.0, 0.2, 0.4, 1.0])
@pytest.mark.parametrize("changed", [False, True])
def test_an_error_of_the_odometry_up_to_a_metre_and_a_degree_is_taken_out(off_m, changed):
    pose = yard.pose(1.0, -2.0, 0.4)
    wrong = pose.copy()
    wrong[:2, 3] += [0.8 * off_m, -0.6 * off_m]
    wrong[:3, :3] = Rotation.from_euler("zy", [1.0, 0.3] if off_m else [0, 0], degrees=True).as_matrix() @ pose[:3, :3]
    known = localizer()
    fix = known.locate(seen_from(pose, surface(1, changed)), motion(wrong), [SCENE])
    assert fix.aligned and fix.residual_m < 0.05
    metres, degrees = error_of(fix, pose)
    assert metres < 0.02 and degrees < 0.1
    np.testing.assert_allclose(known.predict(wrong), fix.T_map_sensor, atol=1e-9)  # the next scan starts from there


def test_another_place_is_no_fix_and_the_reason_is_stated():
    pose = yard.pose(1.0, -2.0, 0.4)
    lane = surface(2) * np.float32([1.8, 0.35, 1.0])  # longer, and seven metres wide
    fix = localizer().locate(seen_from(pose, lane), motion(pose), [SCENE])
    assert not fix.aligned and np.isnan(fix.residual_m)
    assert "the scene's first visit" in fix.reason or "not believed" in fix.reason


def test_in_a_new_place_the_prediction_stands_until_there_are_scans_before():
    pose = yard.pose(1.0, -2.0, 0.4)
    fix = localizer().locate(seen_from(pose, surface(1)), motion(pose), [])
    assert not fix.aligned and fix.reason == "new place"
    np.testing.assert_array_equal(fix.T_map_sensor, pose)


@pytest.fixture
def read():
    """The scenes whose first visit was read, once for each scan."""
    return []


@pytest.fixture
def reading(read):
    def first_visit_noted(scene):
        for cells in first_visit(scene):
            read.append(scene.scene_id)
            yield cells

    return Localizer(Config().alignment, first_visit_noted, np.eye(4))


def test_a_scene_is_read_scan_by_scan_before_the_robot_is_there(reading, read):
    ahead, behind = Scene(1, np.zeros((1, 2))), Scene(2, np.zeros((1, 2)))
    for _ in range(5):
        reading.prepare([ahead, behind])
    assert read == [1, 1, 2, 2]
    pose = yard.pose(1.0, -2.0, 0.4)
    assert reading.locate(seen_from(pose, surface(1)), motion(pose), [ahead]).aligned
    assert read == [1, 1, 2, 2]


def test_where_many_scenes_are_near_none_is_read_twice(reading, read):
    for _ in range(40):
        reading.prepare([Scene(i, np.zeros((1, 2))) for i in range(CACHED_REFERENCES + 3)])
    assert read == sorted(2 * list(range(CACHED_REFERENCES)))


def test_a_scan_of_clutter_is_refused_and_the_prediction_stands():
    rng, pose = np.random.default_rng(0), yard.pose(0.0, 0.0)
    fix = localizer().locate(seen_from(pose, rng.uniform(-40, 40, (100_000, 3))), motion(pose), [SCENE])
    assert not fix.aligned
    np.testing.assert_array_equal(fix.T_map_sensor, pose)


def test_a_scene_of_which_nothing_is_stored_is_as_a_new_place_until_something_is():
    """The disk was full when its scans were taken; small_gicp would end the process."""
    stored, pose = [], yard.pose(1.0, -2.0, 0.4)
    known = Localizer(Config().alignment, lambda scene: iter(stored), np.eye(4))
    fix = known.locate(seen_from(pose, surface(1)), motion(pose), [SCENE])
    assert not fix.aligned and "nothing is stored" in fix.reason
    stored.extend(first_visit(SCENE))
    assert known.locate(seen_from(pose, surface(1)), motion(pose), [SCENE]).aligned
