"""The map of the last key scans: a guess that is a little off is put right, a wrong one is left alone."""

import numpy as np
import pytest
import small_gicp
import yard
from scipy.spatial.transform import Rotation

from revisitd.daemon.local_map import LocalMap

VOXEL_M = 0.5


def cloud(pose):
    """The yard seen from a pose, in the sensor's frame, with covariances."""
    rng = np.random.default_rng(0)
    n = 12_000
    walls = [
        np.column_stack([np.full(n, side * yard.HALF_X_M), rng.uniform(-10, 10, n), rng.uniform(0, yard.WALL_M, n)])
        for side in (-1, 1)
    ] + [
        np.column_stack([rng.uniform(-15, 15, n), np.full(n, side * yard.HALF_Y_M), rng.uniform(0, yard.WALL_M, n)])
        for side in (-1, 1)
    ]
    ground = np.column_stack([rng.uniform(-15, 15, n), rng.uniform(-10, 10, n), np.zeros(n)])
    points = np.vstack([*walls, ground]) + rng.normal(0, 0.01, (5 * n, 3))
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return small_gicp.preprocess_points(local, 0.4, 10, 1)[0]


def off_by(x, degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    T[0, 3] = x
    return T


def test_the_first_scan_is_where_it_was_predicted():
    T = yard.pose(1.0, 2.0, 0.3)
    assert LocalMap(VOXEL_M, 40).refine(cloud(T), T) is T


@pytest.mark.parametrize("off", [off_by(0.1, 0.0), off_by(0.0, 0.5), off_by(-0.05, -0.5)])
def test_a_prediction_that_is_centimetres_off_is_put_right(off):
    known, T = LocalMap(VOXEL_M, 40), yard.pose(0.5, 0.1, 0.02)
    known.add(cloud(yard.pose(0, 0)), yard.pose(0, 0))
    error = np.linalg.inv(T) @ known.refine(cloud(T), T @ off)
    assert np.linalg.norm(error[:3, 3]) < 0.02
    assert np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude()) < 0.1


def test_a_correction_that_is_too_large_is_not_believed_nor_is_a_map_that_was_cleared():
    known, T = LocalMap(VOXEL_M, 40), yard.pose(0.5, 0.1)
    known.add(cloud(yard.pose(0, 0)), yard.pose(0, 0))
    wrong = T @ off_by(0.6, 0.0)
    assert known.refine(cloud(T), wrong) is wrong
    known.clear()
    near = T @ off_by(0.1, 0.0)
    assert known.refine(cloud(T), near) is near
