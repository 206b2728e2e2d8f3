"""Stored scans as detection and alignment want them: deskewed points in the map and depth images."""

from __future__ import annotations

import numpy as np

from ..drivers.frame import Sensor
from ..storage.scans import Scan
from .geometry import column_phase, deskew, transform

OWN_BODY_M = 1.0  # returns nearer are the robot itself: they hide what is behind them, and are of no place


def sensor_points(scan: Scan, sensor: Sensor, range_m: float, every: int = 1) -> np.ndarray:
    """Returns within range of the sensor, of every so-manieth column, (N, 3) float32 metres in its frame at the end."""
    phase = column_phase(scan.column_ns, scan.column_valid)[::every]
    points = deskew(sensor.points(scan.range_mm)[:, ::every], phase, scan.T_start_end)
    range_mm = scan.range_mm[:, ::every]
    near = (range_mm > OWN_BODY_M * 1e3) & (range_mm < range_m * 1e3) & scan.column_valid[::every]
    return points[near]


def map_points(scan: Scan, sensor: Sensor, range_m: float, every: int = 1) -> np.ndarray:
    """Returns within range of the sensor, of every so-manieth column, (N, 3) float32 metres in the map."""
    return transform(scan.T_map_sensor, sensor_points(scan, sensor, range_m, every))
