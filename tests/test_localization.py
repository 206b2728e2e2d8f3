"""A key scan finds its place in a known scene, whatever the odometry says, or says why not."""

import numpy as np
import pytest
import yard
from scipy.spatial.transform import Rotation

from revisitd.daemon.config import Config
from revisitd.daemon.localization import Localizer
from revisitd.daemon.scenes import Scene

SCENE = Scene(1, np.zeros((1, 2)))


def surface(seed, changed=False):
    """(N, 3) float32: the yard and a hut in it, map frame; changed: a car has come and the hut is gone."""
    rng = np.random.default_rng(seed)

    def wall(x, y, z, n):
        return np.column_stack([rng.uniform(*axis, n) for axis in (x, y, z)])

    x, y, z = (-yard.HALF_X_M, yard.HALF_X_M), (-yard.HALF_Y_M, yard.HALF_Y_M), (0.0, yard.WALL_M)
    parts = [wall((s, s), y, z, 9000) for s in x] + [wall(x, (s, s), z, 9000) for s in y]
    parts.append(wall(x, y, (0.0, 0.0), 20_000))
    box = ((4, 8), (3, 5), (0, 1.5)) if changed else ((-6, -4), (-5, -3), (0, 2.5))
    for axis in range(2):
        for side in box[axis]:
            sides = [box[0], box[1], box[2]]
            sides[axis] = (side, side)
            parts.append(wall(*sides, 1500))
    points = np.vstack(parts) + rng.normal(0, 0.01, (sum(map(len, parts)), 3))
    return points.astype(np.float32)


def seen_from(pose, changed=False):
    """The returns of a scan, (N, 3) float32, in the sensor's frame."""
    points = surface(1, changed)
    return ((points - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)


def localizer():
    return Localizer(Config().alignment, lambda scene: surface(0), np.eye(4))


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
    fix = known.locate(seen_from(pose, changed), wrong, [SCENE])
    assert fix.aligned and fix.residual_m < 0.05
    metres, degrees = error_of(fix, pose)
    assert metres < 0.02 and degrees < 0.1
    np.testing.assert_allclose(known.predict(wrong), fix.T_map_sensor, atol=1e-9)  # the next scan starts from there


def test_another_place_is_no_fix_and_the_reason_is_stated():
    pose = yard.pose(1.0, -2.0, 0.4)
    lane = surface(2) * np.float32([1.8, 0.35, 1.0])  # longer, and seven metres wide
    fix = localizer().locate(((lane - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32), pose, [SCENE])
    assert not fix.aligned and np.isnan(fix.residual_m)
    assert "the scene's first visit" in fix.reason or "not believed" in fix.reason


def test_in_a_new_place_the_prediction_stands_until_there_are_scans_before():
    pose = yard.pose(1.0, -2.0, 0.4)
    fix = localizer().locate(seen_from(pose), pose, [])
    assert not fix.aligned and fix.reason == "new place"
    np.testing.assert_array_equal(fix.T_map_sensor, pose)
