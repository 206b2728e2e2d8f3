"""The map of the last key scans: a guess that is a little off is put right, a wrong one is left alone."""

from dataclasses import replace

import numpy as np
import pytest
import yard
from scipy.spatial.transform import Rotation

from revisitd.daemon.geometry import fraction_of, inverse
from revisitd.daemon.local_map import MAX_VOXELS, LocalMap
from revisitd.daemon.plane_map import PlaneMap
from revisitd.daemon.sweep import MAX_CELLS, summed_up
from revisitd.daemon.voxels import moments_of, pooled, voxel_keys

VOXEL_M = CELL_M = 0.5
STILL = np.eye(4)


def yard_points(seed):
    """(N, 3) float64: walls and ground of the yard, map frame."""
    rng, n = np.random.default_rng(seed), 40_000
    x, y, z = (rng.uniform(low, high, n) for low, high in ((-15, 15), (-10, 10), (0, yard.WALL_M)))
    walls = [np.column_stack([np.full(n, side * yard.HALF_X_M), y, z]) for side in (-1, 1)]
    walls += [np.column_stack([x, np.full(n, side * yard.HALF_Y_M), z]) for side in (-1, 1)]
    points = np.vstack([*walls, np.column_stack([x, y, np.zeros(n)])])
    # Shifted, so that no surface lies between two voxels.
    return points + rng.normal(0, 0.01, points.shape) + [0.1, 0.2, 0.15]


def sweep(T_map_sensor, T_start_end=STILL, seed=0):
    """The yard as a sensor sweeps over it, once round by azimuth, that is at a pose at its end."""
    points = yard_points(seed)
    at_end = (points - T_map_sensor[:3, 3]) @ T_map_sensor[:3, :3]
    phase = np.arctan2(at_end[:, 1], at_end[:, 0]) / (2 * np.pi) + 0.5
    T_columns_end = inverse(fraction_of(T_start_end, phase)) @ T_start_end
    own = np.einsum("nij,nj->ni", T_columns_end[:, :3, :3], at_end) + T_columns_end[:, :3, 3]
    return summed_up(own, phase, CELL_M)


def known_yard():
    """A map that has seen the yard once, from a sensor that stood in its middle."""
    known, T = LocalMap(VOXEL_M, 40), yard.pose(0, 0)
    known.add(sweep(T, seed=1).in_map(T, STILL))
    return known


def off_by(x, degrees):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    T[0, 3] = x
    return T


def error_of(T, truth):
    error = np.linalg.inv(truth) @ T
    return np.linalg.norm(error[:3, 3]), np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude())


def test_an_empty_map_says_nothing():
    T = yard.pose(1.0, 2.0, 0.3)
    assert LocalMap(VOXEL_M, 40).refine(sweep(T), T, STILL) is None


@pytest.mark.parametrize("off", [off_by(0.1, 0.0), off_by(0.0, 0.5), off_by(-0.05, -0.5)])
def test_a_prediction_that_is_centimetres_off_is_put_right(off):
    T = yard.pose(0.5, 0.1, 0.02)
    fit = known_yard().refine(sweep(T), T @ off, STILL)
    metres, degrees = error_of(fit.T_map_sensor, T)
    assert metres < 0.01 and degrees < 0.03 and fit.residual_m < 0.03


@pytest.mark.parametrize("axis", "xyz")
def test_a_sweep_bent_by_a_motion_that_nobody_foresaw_is_straightened(axis):
    """A robot rolls and pitches within a sweep: half a degree, of which the poses before it say nothing."""
    T, expected = yard.pose(0.5, 0.1, 0.02), off_by(0.1, 0.0)
    bent = expected.copy()
    bent[:3, :3] = Rotation.from_euler(axis, 0.5, degrees=True).as_matrix()
    fit = known_yard().refine(sweep(T, bent), T, expected)
    metres, degrees = error_of(fit.T_start_end, bent)
    assert metres < 0.01 and degrees < 0.03
    metres, degrees = error_of(fit.T_map_sensor, T)
    assert metres < 0.01 and degrees < 0.03


def test_a_motion_that_is_not_steady_is_straightened_for_the_map():
    """To and fro within a sweep, as on a bumpy road: no steady motion comes near."""
    T, seen = yard.pose(0.5, 0.1, 0.02), sweep(yard.pose(0.5, 0.1, 0.02))
    bend = np.array([0, 0, 0.005, np.radians(0.1), np.radians(-0.05), 0])
    bent = replace(seen, cells=replace(seen.cells, mean=seen.at_end(STILL, -bend)))
    fit = known_yard().refine(bent, T, STILL)
    straight, truth = bent.in_map(fit.T_map_sensor, fit.T_start_end, fit.bend).mean, seen.in_map(T, STILL).mean
    as_steady = bent.in_map(fit.T_map_sensor, fit.T_start_end).mean
    off, off_as_steady = (np.sqrt(((mean - truth) ** 2).mean()) for mean in (straight, as_steady))
    assert off < 0.002 < 2 * off < off_as_steady


def test_on_bare_ground_the_height_is_put_right_and_the_rest_does_not_run_away():
    def scan(seed):
        rng = np.random.default_rng(seed)
        ground = np.column_stack([rng.uniform(-20, 20, (80_000, 2)), rng.normal(-1.3, 0.01, 80_000)])
        return summed_up(ground, np.arctan2(ground[:, 1], ground[:, 0]) / (2 * np.pi) + 0.5, CELL_M)

    known, predicted = LocalMap(VOXEL_M, 40), np.eye(4)
    known.add(scan(0).in_map(np.eye(4), STILL))
    predicted[[0, 2], 3] = 0.05, 0.04
    fit = known.refine(scan(1), predicted, STILL)
    assert np.abs(fit.T_map_sensor[:2, 3]).max() < 0.06 and abs(fit.T_map_sensor[2, 3]) < 0.003


def test_a_correction_that_is_too_large_is_not_believed_nor_is_a_map_that_was_cleared():
    known, T = known_yard(), yard.pose(0.5, 0.1)
    assert known.refine(sweep(T), T @ off_by(0.45, 0.0), STILL) is None
    assert known.refine(sweep(T), T @ off_by(0.1, 0.0), STILL) is not None
    known.clear()
    assert known.refine(sweep(T), T @ off_by(0.1, 0.0), STILL) is None


def test_clutter_all_around_is_cut_to_a_size_that_can_be_registered_in_time():
    """Rain, leaves or noise in every voxel: the work is bounded, whatever comes of it."""
    rng = np.random.default_rng(0)
    scans = [summed_up(rng.uniform(-40, 40, (130_000, 3)), rng.uniform(0, 1, 130_000), CELL_M) for _ in range(2)]
    assert all(len(scan.phase) <= MAX_CELLS for scan in scans)
    known = PlaneMap(VOXEL_M)
    for scan in scans:
        known.add(scan.in_map(np.eye(4), STILL))
    assert len(known) <= 2 * MAX_CELLS < MAX_VOXELS
    known.forget(n_scans=2, n_voxels=15_000)
    assert len(known) <= 15_000
    known.forget(n_scans=0, n_voxels=MAX_VOXELS)
    assert len(known) == 0


def test_points_summed_up_in_two_steps_are_those_summed_up_in_one():
    points = np.random.default_rng(0).normal(0, 2, (5000, 3))
    coarse = np.unique(voxel_keys(points, 4.0), return_inverse=True)[1]
    fine = np.unique(np.column_stack([coarse, voxel_keys(points, 1.0)]), axis=0, return_inverse=True)[1].ravel()
    of_cell = np.zeros(fine.max() + 1, int)
    of_cell[fine] = coarse
    at_once, in_steps = moments_of(points, coarse), pooled(moments_of(points, fine), of_cell)
    for name in at_once.NAMES:
        np.testing.assert_allclose(getattr(in_steps, name), getattr(at_once, name), atol=1e-9)
