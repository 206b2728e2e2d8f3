"""Stored scans as detection and alignment want them: deskewed points in the map and depth images."""

from __future__ import annotations

import numpy as np

from ..drivers.frame import Sensor
from ..storage.scans import Scan
from .geometry import column_phase, deskew, transform

OWN_BODY_M = 1.0  # returns nearer are the robot itself: they hide what is behind them, and are of no place


def map_points(scan: Scan, sensor: Sensor, range_m: float) -> np.ndarray:
    """Returns within range of the sensor, (N, 3) float32 metres in the map."""
    points = deskew(
        sensor.points(scan.range_mm), column_phase(scan.column_ns, scan.column_valid), scan.T_start_end
    )
    near = (scan.range_mm > OWN_BODY_M * 1e3) & (scan.range_mm < range_m * 1e3) & scan.column_valid
    return transform(scan.T_map_sensor, points[near])
