"""The last key scans as one map: where the next one is, and how the sensor moved during it, in a new place."""

from __future__ import annotations

import numpy as np

from .geometry import inverse, rotation_angle_rad
from .plane_map import PlaneMap
from .sweep import Sweep
from .sweep_fit import SweepFit, fit_sweep
from .voxels import Moments

CLEAR_EVERY = 5  # scans between two sweeps of what was not seen for long
MAX_VOXELS = 300_000  # 28 MB; a street fills a hundred thousand
GATE_M = 0.5  # pairs farther apart do not pull
MAX_MOVE_M = 0.3  # between two key scans KISS-ICP is right to some centimetres; more is a wrong match
MAX_TURN_DEG = 2.5
MIN_KNOWN = 0.3  # share of the scan that lies where the scans before met something


class LocalMap:
    """Planes in voxels of voxel_m; what the last n_scans scans did not touch is dropped, so its size is bounded."""

    def __init__(self, voxel_m: float, n_scans: int):
        self._voxel_m = voxel_m
        self._n_scans = n_scans
        self.clear()

    def clear(self) -> None:
        """Forget all: the map's frame has moved."""
        self._planes = PlaneMap(self._voxel_m)
        self._scans = 0

    def refine(self, sweep: Sweep, T_map_sensor: np.ndarray, T_start_end: np.ndarray) -> SweepFit | None:
        """Pose and motion of a sweep by the scans before it, from a prediction; None where they say nothing."""
        if len(self._planes) == 0:
            return None
        fit = fit_sweep(sweep, T_map_sensor, T_start_end, self._planes.planes_at, GATE_M)
        moves = inverse(T_map_sensor) @ fit.T_map_sensor, inverse(T_start_end) @ fit.T_start_end
        moved = max(np.linalg.norm(T[:3, 3]) for T in moves)
        turned = max(np.degrees(rotation_angle_rad(T)) for T in moves)
        return fit if fit.known_ratio >= MIN_KNOWN and moved < MAX_MOVE_M and turned < MAX_TURN_DEG else None

    def add(self, cells: Moments) -> None:
        """One more scan, where it was found to be."""
        self._planes.add(cells)
        self._scans += 1
        if self._scans % CLEAR_EVERY == 0:
            self._planes.forget(self._n_scans, MAX_VOXELS)
