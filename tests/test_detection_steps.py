"""Each step of the detector against brute force or a world known by construction."""

from dataclasses import replace

import numpy as np
import plain
import pytest
from scipy.spatial.distance import cdist
from stored import make_scan, pose

from revisitd.daemon.detection.candidates import changed, dense_enough
from revisitd.daemon.detection.clusters import cluster, thin
from revisitd.daemon.detection.ground import is_ground_like, segment_ground
from revisitd.daemon.detection.occlusion import persistent, sight
from revisitd.daemon.detection.submap import AT, GLIMPSED, HIDDEN, OPEN, THROUGH, UNKNOWN, Submap, depth_image
from revisitd.daemon.submap_build import scan_view
from revisitd.drivers.metadata import sensor_from_metadata
from revisitd.drivers.virtual.sensor import virtual_metadata

ALTITUDES = np.radians(np.linspace(22.5, -22.5, 64)).astype(np.float32)


def mean_distance(points, reference, n, skip_self=False):
    distances = np.sort(cdist(points, reference), axis=1)[:, int(skip_self) :]
    return distances[:, :n].mean(axis=1)


@pytest.mark.parametrize("n", [1, 3, 5])
@pytest.mark.parametrize("tau", [0.1, 0.3, 0.5])
def test_candidates_are_exactly_those_of_a_full_search(n, tau):
    rng = np.random.default_rng(n)
    reference = (rng.random((3000, 3)) * [4, 4, 1.2]).astype(np.float32)
    points = (rng.random((1500, 3)) * [6, 6, 3] - 1).astype(np.float32)
    expected = mean_distance(points, reference, n) > tau
    assert 0.02 < expected.mean() < 0.999
    np.testing.assert_array_equal(changed(points, reference, tau, n), expected)


def test_everything_is_a_candidate_against_nothing():
    points = np.zeros((4, 3), np.float32)
    assert changed(points, np.zeros((0, 3), np.float32), 0.3, 5).all()
    assert changed(np.zeros((0, 3), np.float32), points, 0.3, 5).shape == (0,)


def test_the_noise_filter_is_exactly_the_mean_distance_to_fellow_candidates():
    points = (np.random.default_rng(0).random((2000, 3)) * [4, 4, 1.2]).astype(np.float32)
    expected = mean_distance(points, points, 5, skip_self=True) < 0.15
    assert 0.05 < expected.mean() < 0.95
    np.testing.assert_array_equal(dense_enough(points, 0.15, 5), expected)


def test_clusters_are_the_components_of_near_pairs():
    a = np.random.default_rng(1).random((50, 3)).astype(np.float32) * 0.3
    labels = cluster(np.vstack([a, a + [1.0, 0, 0], a + [1.0, 0, 0.5]]), 0.4)
    assert len(set(labels[:50])) == 1 and len(set(labels[50:])) == 1 and labels[0] != labels[50]


def test_thinning_keeps_one_point_for_each_voxel():
    points = np.array([[0.01, 0.01, 0.01], [0.02, 0.02, 0.02], [0.06, 0.01, 0.01], [-0.01, 0, 0]], np.float32)
    assert thin(points).tolist() == [0, 2, 3]


def test_a_stored_scan_becomes_the_points_and_the_depth_image_of_the_plain_version():
    sensor = sensor_from_metadata(virtual_metadata(32, 512))
    range_mm = np.random.default_rng(2).integers(0, 40_000, sensor.shape).astype(np.uint32)
    range_mm[range_mm < 3000] = 0
    range_mm[:, 100:160] = 0
    column_valid = np.arange(512) % 50 != 7
    column_ns = np.where(column_valid, 10**9 + np.arange(512) * 195_000, 0)
    T_start_end = pose(0.2, 0.03, 0.01, yaw=0.05)
    scan = make_scan(
        range_mm=range_mm, column_valid=column_valid, column_ns=column_ns, T_start_end=T_start_end,
        T_map_sensor=pose(30.0, -20.0, 1.0, yaw=2.0),
    )  # fmt: skip
    _, points, image = scan_view(scan, sensor, 25.0)
    _, expected, expected_image = plain.scan_view(scan, sensor, 25.0)
    np.testing.assert_allclose(points, expected, atol=1e-3)
    assert np.isclose(image.depth, expected_image.depth, atol=1e-3).mean() > 0.999  # on a pixel's rim: either side
    places = (np.random.default_rng(3).normal(size=(20_000, 3)) * 8 + [30.0, -20.0, 1.0]).astype(np.float32)
    looks = image.look_at(places, 0.3, 18.0)
    assert (looks == plain.look_at(expected_image, places, 0.3, 18.0)).mean() > 0.995
    assert set(looks) == {UNKNOWN, THROUGH, AT, GLIMPSED, HIDDEN, OPEN}


# Ground ---------------------------------------------------------------------------------------------------------


def world(slope=0.0, tilt=0.0, seed=0):
    """Rolling ground, a wall, a car-sized box, and a bag of 30 cm: points and which are ground."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-20, 20, (150_000, 2))
    height = slope * xy[:, 0] + 0.15 * np.sin(xy[:, 1] / 5) - 1.5
    ground = np.column_stack([xy, height + rng.normal(0, 0.015, len(xy))])

    def box(x, y, size, n):
        p = rng.uniform(0, 1, (n, 3)) * size
        face = rng.integers(0, 5, n)
        for axis, value, f in ((0, 0, 0), (0, 1, 1), (1, 0, 2), (1, 1, 3), (2, 1, 4)):
            p[face == f, axis] = value * size[axis]
        return p + [x, y, slope * x + 0.15 * np.sin(y / 5) - 1.5]

    things = [box(5, 5, np.array([4, 1.8, 1.5]), 9000), box(-8, -6, np.array([10, 0.3, 3]), 20000)]
    bag = box(2, -3, np.array([0.4, 0.3, 0.3]), 800)
    points = np.vstack([ground, *things, bag])
    c, s = np.cos(tilt), np.sin(tilt)
    points = points @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    kind = np.repeat([0, 1, 1, 2], [len(ground), 9000, 20000, 800])
    return points.astype(np.float32), kind


@pytest.mark.parametrize("slope,tilt", [(0, 0), (0.12, 0), (0, np.radians(5)), (-0.08, np.radians(-3))])
def test_ground_is_found_on_slopes_and_under_a_tilted_sensor(slope, tilt):
    points, kind = world(slope, tilt)
    is_ground, _ = segment_ground(points, np.zeros(2), 3.0, 0.035)
    assert is_ground[kind == 0].mean() > 0.98
    assert is_ground[kind == 1].mean() < 0.12  # the lowest decimetre of walls and sills looks like ground
    assert is_ground[kind == 2].mean() < 0.45


def test_the_ground_is_that_of_the_plain_version_but_for_the_rims_of_bins():
    points, _ = world(0.05)
    is_ground, _ = segment_ground(points, np.zeros(2), 3.0, 0.035)
    assert (is_ground == plain.segment_ground(points, np.zeros(2), 3.0, 0.035)[0]).mean() > 0.998


def test_no_ground_is_invented_without_points_for_it():
    points = np.array([[0, 0, 0], [1, 1, 3], [2, 2, 1]], np.float32)
    is_ground, ground = segment_ground(points, np.zeros(2), 3.0, 0.035)
    assert not is_ground.any()
    assert not ground.is_under(points, 3.0, 0.035).any()


def test_a_patch_of_ground_is_ground_like_and_a_bag_is_not():
    points, kind = world()
    _, ground = segment_ground(points, np.zeros(2), 3.0, 0.035)
    patch = points[(kind == 0) & (np.abs(points[:, 0] - 10) < 1) & (np.abs(points[:, 1]) < 1)]
    assert is_ground_like(patch + np.float32([0, 0, 0.08]), ground, 0.15, 0.9)
    bump = patch[np.linalg.norm(patch[:, :2] - [10, 0], axis=1) < 0.6] + np.float32([0, 0, 0.2])
    assert is_ground_like(bump, ground, 0.15, 0.9)
    assert not is_ground_like(points[kind == 2], ground, 0.15, 0.9)
    low = points[kind == 2]
    assert not is_ground_like(low[low[:, 2] < np.quantile(low[:, 2], 0.6)], ground, 0.15, 0.9)
    assert not is_ground_like(patch + np.float32([0, 0, 0.5]), ground, 0.15, 0.9)


# Sight ----------------------------------------------------------------------------------------------------------


def wall_at(x, half_width=20.0):
    """Returns of a scan at the origin from a wall across the x axis, in its own directions."""
    azimuth = (np.arange(1024) + 0.5) * 2 * np.pi / 1024
    altitude, turn = np.meshgrid(ALTITUDES, azimuth, indexing="ij")
    direction = np.stack([np.cos(altitude) * np.cos(turn), np.cos(altitude) * np.sin(turn), np.sin(altitude)], -1)
    with np.errstate(divide="ignore"):
        points = direction * (x / direction[..., :1])
    ahead = (direction[..., 0] > 0.1) & (np.abs(points[..., 1]) < half_width)
    return points[ahead].astype(np.float32)


def image(points, T=None):
    return depth_image(points, np.eye(4) if T is None else T, ALTITUDES, 1024)


def test_a_point_before_a_wall_is_looked_through_one_behind_it_is_unknown():
    points = np.array([[5, 0, 0], [10, 1, 0.5], [14, 0, 0]], np.float32)
    seen = sight(points, [image(wall_at(10.0))], 0.3, 18.0)
    assert seen.through.tolist() == [1, 0, 0]
    assert seen.at.tolist() == [0, 1, 0]


def test_no_return_is_not_free_space():
    points = np.array([[5, 0, 0], [0, 5, 0], [3, 0, 3]], np.float32)  # beside the wall's edge, above the beams
    seen = sight(points[1:], [image(wall_at(10.0))], 0.3, 18.0)
    assert not seen.through.any() and not seen.at.any()


def test_a_scan_too_far_away_confirms_nothing():
    seen = sight(np.array([[17, 0, 0], [19, 0, 0]], np.float32), [image(wall_at(25.0))], 0.3, 18.0)
    assert seen.through.tolist() == [1, 0]


def test_a_sensor_that_moved_and_turned_sees_the_same():
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T[:3, 3] = [3, 4, 0.5]
    before_wall = np.array([[5, 0.3, 0.2]], np.float32)
    in_map = before_wall @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    assert sight(in_map, [image(wall_at(10.0), T)], 0.3, 18.0).through.tolist() == [1]


def test_what_the_own_visit_looks_through_has_not_stayed():
    with_person = np.vstack([wall_at(10.0), np.tile([[5, 0, 0]], (3, 1)).astype(np.float32)])
    empty = image(wall_at(10.0))
    standing = image(wall_at(5.0, half_width=0.3))
    person = np.array([[5, 0, 0]], np.float32)
    scan = np.zeros(1, np.int16)
    stamps = np.arange(10) * 1_000_000_000

    def submap(images, visit):
        return Submap(with_person, np.zeros(len(with_person), np.int16), images, np.array(visit), stamps)

    walked_on = submap([standing, empty, empty, empty], [1, 1, 1, 1])
    stayed = submap([standing] * 4, [1, 1, 1, 1])
    appeared_later = submap([standing] * 3 + [empty, empty], [2, 2, 2, 1, 1])
    assert not persistent(person, scan, walked_on, 0.3, 18.0, 3, 2.0, False, True)[0]
    assert persistent(person, scan, stayed, 0.3, 18.0, 3, 2.0, False, True)[0]
    assert not persistent(person, scan, replace(stayed, stamp_ns=stamps // 10), 0.3, 18.0, 3, 2.0, False, True)[0]
    came_in_between = submap([empty] * 4 + [standing] * 6, [1] * 10)
    came_and_went = submap([empty] * 2 + [standing] * 6 + [empty] * 2, [1] * 10)
    assert persistent(person, scan, came_in_between, 0.3, 18.0, 3, 2.0, False, True)[0]
    assert not persistent(person, scan, came_in_between, 0.3, 18.0, 3, 2.0, False, False)[0]
    assert not persistent(person, scan, came_and_went, 0.3, 18.0, 3, 2.0, False, True)[0]
    assert persistent(person, scan, appeared_later, 0.3, 18.0, 3, 2.0, False, True)[0]
