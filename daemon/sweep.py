"""One rotation of the sensor as the registration wants it: few points, each still in the frame of its own moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..drivers.frame import Frame, Sensor
from ..storage.scans import Scan
from .geometry import column_phase, inverse
from .views import OWN_BODY_M
from .voxels import Moments, moments_of, voxel_keys

STEADY = np.zeros(6)
MAX_CELLS = 20_000  # an OS1-128 in a street fills 12 thousand; rain or leaves all around do not stop the registration


@dataclass(frozen=True, eq=False)
class Sweep:
    """The returns of one rotation, summed up in N cells.

    cells: their points (metres, sensor frame at each cell's own moment); phase (N,): that moment, from 0 (the sweep's
    start) to 1 (its end).
    """

    cells: Moments
    phase: np.ndarray

    @property
    def bow(self) -> np.ndarray:
        """(N,): the lowest shape of an unsteady motion, a parabola over the sweep; no steady motion resembles it."""
        return 6.0 * self.phase * (1.0 - self.phase) - 1.0

    def at_end(self, T_start_end: np.ndarray, bend: np.ndarray = STEADY) -> np.ndarray:
        """The cells' means (N, 3) in the sensor frame at the end of a steady motion (4, 4).

        bend (6,): how far the sensor was off it, metres and a rotation vector, times bow.
        """
        T_end_start = inverse(T_start_end)
        # As in deskew(): rotation vector and translation are scaled apart.
        turned = Rotation.from_rotvec(self.phase[:, None] * Rotation.from_matrix(T_start_end[:3, :3]).as_rotvec())
        at_start = turned.apply(self.cells.mean) + self.phase[:, None] * T_start_end[:3, 3]
        at_end = at_start @ T_end_start[:3, :3].T + T_end_start[:3, 3]
        return at_end + self.bow[:, None] * (bend[:3] + np.cross(bend[3:], at_end))

    def in_map(self, T_map_sensor: np.ndarray, T_start_end: np.ndarray, bend: np.ndarray = STEADY) -> Moments:
        """The cells in the map, for a pose at the end of a steady motion, (4, 4) each, and how far it was off that."""
        R = T_map_sensor[:3, :3]
        # A cell's spread turns with the sweep by some degrees at most: nothing beside its cell's size.
        mean = self.at_end(T_start_end, bend) @ R.T + T_map_sensor[:3, 3]
        return Moments(self.cells.count, mean, R @ self.cells.covariance @ R.T)


def sweep_of(image: Frame | Scan, sensor: Sensor, range_m: float, cell_m: float) -> Sweep:
    """The returns of a rotation from within range."""
    mm = image.range_mm
    used = (mm > OWN_BODY_M * 1e3) & (mm < range_m * 1e3) & image.column_valid
    phase = np.broadcast_to(column_phase(image.column_ns, image.column_valid), mm.shape)[used]
    return summed_up(sensor.points(mm)[used], phase, cell_m)


def summed_up(points: np.ndarray, phase: np.ndarray, cell_m: float) -> Sweep:
    """The sweep of returns (N, 3), metres, each in the sensor frame of its own moment: phase (N,) from 0 to 1."""
    # A sweep's first and last columns are neighbours, a tenth of a second apart: they are not averaged.
    key = 2 * voxel_keys(points, cell_m) + (phase > 0.5)
    _, cell = np.unique(key, return_inverse=True)
    cells = moments_of(points, cell)
    every = -(-len(cells.count) // MAX_CELLS)
    kept = Moments(*(getattr(cells, name)[::every] for name in Moments.NAMES))
    return Sweep(kept, (np.bincount(cell, phase) / cells.count)[::every])
