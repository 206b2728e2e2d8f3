"""Which scans are kept: by motion, and by time when the robot stands."""

from __future__ import annotations

import numpy as np

from .config import KeyScanConfig
from .geometry import inverse, rotation_angle_rad


class KeyScanRule:
    """A scan is kept when the robot moved or turned enough since the last one kept, or time has passed."""

    def __init__(self, config: KeyScanConfig):
        self._config = config
        self._T_odom_last: np.ndarray | None = None
        self._stamp_ns = 0

    def wants(self, T_odom_sensor: np.ndarray, stamp_ns: int) -> bool:
        """Whether to keep the scan at this pose (4, 4); remembers it if so."""
        if self._T_odom_last is not None:
            motion = inverse(self._T_odom_last) @ T_odom_sensor
            if (
                np.linalg.norm(motion[:3, 3]) < self._config.distance_m
                and np.degrees(rotation_angle_rad(motion)) < self._config.angle_deg
                and stamp_ns - self._stamp_ns < self._config.interval_s * 1e9
            ):
                return False
        self._T_odom_last, self._stamp_ns = T_odom_sensor.copy(), stamp_ns
        return True
