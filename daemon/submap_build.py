"""Stored scans to a submap: decoded, deskewed and seen from the middle of their sweeps. Of the detection process."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ..drivers.frame import Sensor
from ..storage.errors import ScanFileError
from ..storage.scans import Scan
from .detection.jit import kernel
from .detection.submap import DepthImage, Submap, depth_image
from .geometry import column_phase, fraction_of, inverse
from .views import OWN_BODY_M

logger = logging.getLogger(__name__)

# Depth images are taken from the middle of the sweep: half the parallax of either end.
MID_SWEEP = 0.5
THREADS = 2


def build_submap(
    read: Callable[[int], tuple[Scan, Sensor]], visits: np.ndarray, range_m: float
) -> tuple[Submap, list[Scan], np.ndarray]:
    """The submap of some scans, read(0) to read(S - 1), of visits (S,); read and projected on two threads.

    Scans that cannot be read (ScanFileError: just deleted by the retention, or damaged) are done without; the last
    result says which are there, (S,) bool.
    """

    def view(i: int) -> tuple[Scan, np.ndarray, DepthImage] | None:
        try:
            return scan_view(*read(i), range_m)
        except ScanFileError as error:
            logger.warning("compared without a scan: %s", error)
            return None

    with ThreadPoolExecutor(THREADS, thread_name_prefix="submap") as pool:
        tried = list(pool.map(view, range(len(visits))))
    there = np.array([found is not None for found in tried], dtype=bool)
    views = [found for found in tried if found is not None]
    scans = [view[0] for view in views]
    points = np.concatenate([np.empty((0, 3), np.float32), *(view[1] for view in views)])
    scan_index = np.repeat(np.arange(len(views), dtype=np.int16), [len(view[1]) for view in views])
    stamps = np.array([scan.stamp_ns for scan in scans], dtype=np.int64)
    return Submap(points, scan_index, [view[2] for view in views], visits[there], stamps), scans, there


def scan_view(scan: Scan, sensor: Sensor, range_m: float) -> tuple[Scan, np.ndarray, DepthImage]:
    """One scan of a submap: its points within range (N, 3) float32 in the map, and its depth image."""
    to_mid = inverse(fraction_of(scan.T_start_end, MID_SWEEP))
    T_mid_columns = to_mid @ fraction_of(scan.T_start_end, column_phase(scan.column_ns, scan.column_valid))
    # The beams leave from around the lidar's own origin, a little above the sensor's: elevations are true there.
    T_mid_columns[:, :3, 3] -= sensor.lidar_origin
    T_map_vantage = scan.T_map_sensor @ inverse(to_mid @ scan.T_start_end)
    T_map_vantage[:3, 3] += T_map_vantage[:3, :3] @ sensor.lidar_origin
    points, range_mm = _returns(
        scan.range_mm, scan.column_valid, sensor.direction, sensor.offset, T_mid_columns.astype(np.float32), OWN_BODY_M
    )
    image = depth_image(points, T_map_vantage, sensor.altitude_rad, sensor.shape[1])
    return scan, _placed(points, range_mm, T_map_vantage.astype(np.float32), range_m), image


@kernel
def _returns(range_mm, column_valid, direction, offset, T_to_columns, min_range_m):
    """Returns (N, 3) from beyond min_range, each column's under its transform (W, 4, 4); and their ranges (N,) mm."""
    height, width = range_mm.shape
    points = np.empty((height * width, 3), np.float32)
    ranges = np.empty(height * width, np.uint32)
    n = 0
    for row in range(height):
        for column in range(width):
            mm = range_mm[row, column]
            if mm <= min_range_m * 1e3 or not column_valid[column]:
                continue
            metres = np.float32(mm) * np.float32(1e-3)
            x = metres * direction[row, column, 0] + offset[row, column, 0]
            y = metres * direction[row, column, 1] + offset[row, column, 1]
            z = metres * direction[row, column, 2] + offset[row, column, 2]
            T = T_to_columns[column]
            for axis in range(3):
                points[n, axis] = T[axis, 0] * x + T[axis, 1] * y + T[axis, 2] * z + T[axis, 3]
            ranges[n] = mm
            n += 1
    return points[:n], ranges[:n]


@kernel
def _placed(points, range_mm, T, range_m):
    """Those of the points within range, under T (4, 4)."""
    out = np.empty((len(points), 3), np.float32)
    n = 0
    for i in range(len(points)):
        if range_mm[i] < range_m * 1e3:
            for axis in range(3):
                out[n, axis] = (
                    T[axis, 0] * points[i, 0] + T[axis, 1] * points[i, 1] + T[axis, 2] * points[i, 2] + T[axis, 3]
                )
            n += 1
    return out[:n].copy()
