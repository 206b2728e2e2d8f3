"""Overlap of two scans, from their true poses."""

import numpy as np
import pytest
import yard

from revisitd.models.overlap import RangeView, overlap, overlap_matrix, view_of_scan


def view(x, y, yaw=0.0, count=64, columns=512, **kwargs):
    shift, altitude = yard.beams(count, columns)
    return view_of_scan(yard.scan(count, columns, x, y, yaw, **kwargs), shift, altitude), yard.pose(x, y, yaw)


def test_a_scan_overlaps_itself_wholly():
    here, pose = view(2, -1)
    assert overlap(here, here, pose, pose) == 1.0


def test_scans_of_places_far_apart_share_nothing():
    here, pose = view(2, -1)
    far = pose.copy()
    far[0, 3] += 500.0
    assert overlap(here, here, pose, far) == 0.0


def test_overlap_does_not_depend_on_the_order_of_the_scans():
    (a, pose_a), (b, pose_b) = view(2, -1), view(-6, 3, yaw=2.0)
    assert overlap(a, b, pose_a, pose_b) == overlap(b, a, pose_b, pose_a)


def test_overlap_does_not_depend_on_where_the_sensor_faces():
    (a, pose_a), (b, pose_b) = view(2, -1), view(2, -1, yaw=2.345)
    assert overlap(a, b, pose_a, pose_b) > 0.99


def test_overlap_falls_as_the_scans_part():
    here, pose = view(0, 0)
    there = [view(x, 0) for x in (0.2, 1.0, 5.0, 14.0)]
    values = [overlap(here, other, pose, other_pose) for other, other_pose in there]
    assert values == sorted(values, reverse=True) and values[0] > 0.99


def test_what_stands_behind_something_nearer_is_not_shared():
    open_view, pose = view(0, 0)
    _, altitude = yard.beams(64, 512)
    behind = (open_view.range_m > 3.0) & (np.arange(512) < 256)
    screened = RangeView(np.where(behind, 2.0, open_view.range_m).astype(np.float32), altitude)
    assert overlap(open_view, screened, pose, pose) == pytest.approx(0.5, abs=0.03)


def test_a_direction_without_return_is_not_shared():
    whole, pose = view(0, 0)
    holed, _ = view(0, 0, hidden=(0.0, np.pi))
    # Half of the whole scan's returns find nothing there; all that the other has, it shares.
    assert overlap(whole, holed, pose, pose) == pytest.approx(0.75, abs=0.03)


def test_an_empty_scan_overlaps_nothing():
    here, pose = view(0, 0)
    empty = RangeView(np.zeros_like(here.range_m), here.altitude_rad)
    assert overlap(here, empty, pose, pose) == 0.0


def test_the_matrix_holds_the_overlap_of_each_pair():
    views, poses = zip(view(2, -1), view(-6, 3, yaw=2.0), view(8, 8), strict=True)
    matrix = overlap_matrix(list(views), np.stack(poses), 100_000)
    assert np.array_equal(matrix, matrix.T) and np.all(np.diag(matrix) == 1)
    assert matrix[0, 2] == pytest.approx(overlap(views[0], views[2], poses[0], poses[2]), abs=1e-2)


def test_fewer_points_give_nearly_the_same_overlap():
    (a, pose_a), (b, pose_b) = view(2, -1), view(-6, 3)
    assert overlap(a, b, pose_a, pose_b, n_max=1024) == pytest.approx(overlap(a, b, pose_a, pose_b), abs=0.05)
