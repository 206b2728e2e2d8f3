"""Stored scans as detection and alignment want them: deskewed points in the map and depth images."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..drivers.frame import Sensor
from ..storage.scans import Scan
from .detection.submap import DepthImage, Submap, depth_image
from .geometry import column_phase, deskew, fraction_of, inverse, transform

# Depth images are taken from the middle of the sweep: half the parallax of either end.
MID_SWEEP = 0.5
OWN_BODY_M = 1.0  # returns nearer are the robot itself: they hide what is behind them, and are of no place


def swept_points(scan: Scan, sensor: Sensor, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """All pixels as seen at one phase of the sweep, (H, W, 3) float32 metres, sensor frame; which are returns."""
    columns = column_phase(scan.column_ns, scan.column_valid)
    points = deskew(sensor.points(scan.range_mm), columns, scan.T_start_end, phase)
    return points, (scan.range_mm > OWN_BODY_M * 1e3) & scan.column_valid


def map_points(scan: Scan, sensor: Sensor, range_m: float) -> np.ndarray:
    """Returns within range of the sensor, (N, 3) float32 metres in the map."""
    points, valid = swept_points(scan, sensor, 1.0)
    near = valid & (scan.range_mm < range_m * 1e3)
    return transform(scan.T_map_sensor, points[near])


def scan_view(scan: Scan, sensor: Sensor, range_m: float) -> tuple[np.ndarray, DepthImage]:
    """One scan of a submap: its points within range (N, 3) float32 in the map, and its depth image."""
    points, valid = swept_points(scan, sensor, MID_SWEEP)
    T_map_mid = scan.T_map_sensor @ inverse(scan.T_start_end) @ fraction_of(scan.T_start_end, MID_SWEEP)
    # The beams leave from around the lidar's own origin, a little above the sensor's: elevations are true there.
    lidar_origin = sensor.offset.reshape(-1, 3).mean(axis=0)
    T_map_vantage = T_map_mid.copy()
    T_map_vantage[:3, 3] += T_map_mid[:3, :3] @ lidar_origin
    image = depth_image(points[valid] - lidar_origin, T_map_vantage, sensor.altitude_rad, sensor.shape[1])
    near = valid & (scan.range_mm < range_m * 1e3)
    return transform(T_map_mid, points[near]), image


def build_submap(scans: list[Scan], sensors: list[Sensor], visits: np.ndarray, range_m: float) -> Submap:
    """The submap of some scans (S of them, visits (S,)); decoding and projection run on two threads."""
    with ThreadPoolExecutor(2, thread_name_prefix="submap") as pool:
        views = list(pool.map(lambda pair: scan_view(*pair, range_m), zip(scans, sensors, strict=True)))
    points = np.concatenate([view[0] for view in views])
    scan_index = np.repeat(np.arange(len(views), dtype=np.int16), [len(view[0]) for view in views])
    stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    return Submap(points, scan_index, [view[1] for view in views], visits, stamps)
