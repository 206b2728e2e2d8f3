"""How much two scans see of the same surfaces, from their true poses.

Definition. A return of scan A is *shared with B* if, moved into B's sensor frame, it falls inside B's vertical
field of view and one of the four pixels of B around that direction (beam above and below, column left and right)
measured the same range within ``MARGIN_M``. A return hidden from B by something nearer, outside B's view, or in a
direction where B had no return is not shared. ``share(A, B)`` is the shared part of A's returns; ``overlap(A, B)``
is the mean of ``share(A, B)`` and ``share(B, A)``. It is symmetric, 1 for identical scans, 0 for disjoint ones, and
does not depend on where either sensor faces.

Ground that B sees too flatly to resolve (its range jumps by more than the margin from one beam to the next) counts
only where a beam happens to hit: overlap asks for the same surface seen at a comparable density. It is therefore a
statement about scans of one sensor; training and benchmark state it for a reference of 64 beams and 512 columns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MARGIN_M = 0.5


@dataclass(frozen=True, eq=False)
class RangeView:
    """One scan as a range image in its own sensor frame, columns aligned by azimuth.

    range_m: (H, W) float32 metres, 0 = no return; columns evenly spaced, azimuth falling as the column grows.
    altitude_rad: (H,) float, falling from the top row.
    azimuth_0_rad: azimuth of column 0.
    """

    range_m: np.ndarray
    altitude_rad: np.ndarray
    azimuth_0_rad: float = 0.0

    def points(self, n_max: int | None = None) -> np.ndarray:
        """(N, 3) float32 metres, sensor frame: the returns, or about `n_max` of them, evenly thinned."""
        rows, columns = np.nonzero(self.range_m > 0)
        if n_max is not None and rows.size > n_max:
            kept = np.linspace(0, rows.size - 1, n_max).astype(np.intp)
            rows, columns = rows[kept], columns[kept]
        ranges = self.range_m[rows, columns]
        altitude = self.altitude_rad[rows]
        azimuth = self.azimuth_0_rad - columns * (2 * np.pi / self.range_m.shape[1])
        flat = ranges * np.cos(altitude)
        xyz = (flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(altitude))
        return np.stack(xyz, axis=-1).astype(np.float32)


def view_of_scan(range_mm: np.ndarray, pixel_shift: np.ndarray, altitude_rad: np.ndarray,
                 azimuth_0_rad: float = 0.0) -> RangeView:
    """The view of one staggered range image: (H, W) uint32 mm, (H,) int columns, (H,) rad."""
    height, width = range_mm.shape
    columns = (np.arange(width)[None, :] - np.asarray(pixel_shift)[:, None]) % width
    aligned = range_mm[np.arange(height)[:, None], columns]
    return RangeView(aligned.astype(np.float32) * 1e-3, np.asarray(altitude_rad, np.float32), azimuth_0_rad)


def share(points_a: np.ndarray, view_b: RangeView, T_b_a: np.ndarray) -> float:
    """Part of A's returns that B sees too, in [0, 1]; points_a: (N, 3) metres in A's frame; 0 if A is empty."""
    if len(points_a) == 0:
        return 0.0
    points = points_a @ T_b_a[:3, :3].T.astype(np.float32) + T_b_a[:3, 3].astype(np.float32)
    ranges = np.maximum(np.linalg.norm(points, axis=1), 1e-6)
    above, below, inside = _rows_around(np.arcsin(points[:, 2] / ranges), view_b.altitude_rad)
    width = view_b.range_m.shape[1]
    turn = (view_b.azimuth_0_rad - np.arctan2(points[:, 1], points[:, 0])) * (width / (2 * np.pi))
    left = np.floor(turn).astype(np.intp)
    agrees = np.zeros(len(points), bool)
    for row, column in ((above, left), (above, left + 1), (below, left), (below, left + 1)):
        measured = view_b.range_m[row, column % width]
        agrees |= (measured > 0) & (np.abs(measured - ranges) <= MARGIN_M)
    return float(np.count_nonzero(agrees & inside) / len(points))


def overlap(view_a: RangeView, view_b: RangeView, T_map_a: np.ndarray, T_map_b: np.ndarray,
            n_max: int | None = None) -> float:
    """Overlap of two scans in [0, 1], as defined above; T_map_*: (4, 4) true poses; n_max thins the points."""
    T_b_a = np.linalg.solve(T_map_b, T_map_a)
    a_in_b = share(view_a.points(n_max), view_b, T_b_a)
    b_in_a = share(view_b.points(n_max), view_a, np.linalg.inv(T_b_a))
    return 0.5 * (a_in_b + b_in_a)


def overlap_matrix(views: list[RangeView], T_map_sensor: np.ndarray, n_max: int | None = None) -> np.ndarray:
    """(N, N) float32 overlaps of every pair of N scans of one world; T_map_sensor: (N, 4, 4)."""
    points = [view.points(n_max) for view in views]
    T_sensor_map = np.linalg.inv(T_map_sensor)
    shares = np.eye(len(views), dtype=np.float32)
    for a, b in zip(*np.nonzero(~np.eye(len(views), dtype=bool)), strict=True):
        shares[a, b] = share(points[a], views[b], T_sensor_map[b] @ T_map_sensor[a])
    return 0.5 * (shares + shares.T)


def _rows_around(altitude: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows just above and below each altitude (clipped to the image), and whether it is in the field of view."""
    below = np.searchsorted(-beams, -altitude)
    last = len(beams) - 1
    half_beam = 0.5 * (beams[0] - beams[-1]) / max(last, 1)
    inside = (altitude <= beams[0] + half_beam) & (altitude >= beams[-1] - half_beam)
    return np.clip(below - 1, 0, last), np.clip(below, 0, last), inside
