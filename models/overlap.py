"""How much two scans see of the same surfaces, from their true poses.

Definition. A return of scan A is *shared with B* if, moved into B's sensor frame, it falls inside B's
vertical field of view and one of the four pixels of B around that direction (beam above and below, column
left and right) measured the same range within ``MARGIN_M``. A return hidden from B by something nearer,
outside B's view, or in a direction where B had no return is not shared. ``share(A, B)`` is the shared part
of A's returns; ``overlap(A, B)`` is the mean of ``share(A, B)`` and ``share(B, A)``. It is symmetric, 1 for
identical scans, 0 for disjoint ones, and does not depend on where either sensor faces.

Ground that B sees too flatly to resolve (its range jumps by more than the margin from one beam to the next)
counts only where a beam happens to hit: overlap asks for the same surface seen at a comparable density. It
is therefore a statement about scans of one sensor; training and benchmark state it for a reference of 64
beams and 512 columns.
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


def view_of_scan(
    range_mm: np.ndarray, pixel_shift: np.ndarray, altitude_rad: np.ndarray, azimuth_0_rad: float = 0.0
) -> RangeView:
    """The view of one staggered range image: (H, W) uint32 mm, (H,) int columns, (H,) rad."""
    height, width = range_mm.shape
    columns = (np.arange(width)[None, :] - np.asarray(pixel_shift)[:, None]) % width
    aligned = range_mm[np.arange(height)[:, None], columns]
    return RangeView(aligned.astype(np.float32) * 1e-3, np.asarray(altitude_rad, np.float32), azimuth_0_rad)


def share(points_a: np.ndarray, view_b: RangeView, T_b_a: np.ndarray) -> np.ndarray:
    """Part of A's returns that B sees too, in [0, 1]; 0 if A is empty.

    points_a: (..., N, 3) metres, A's frame, of one or several scans; T_b_a: (..., 4, 4) -> (...).
    """
    if points_a.shape[-2] == 0:
        return np.zeros(points_a.shape[:-2])
    T_b_a = np.asarray(T_b_a, np.float32)
    points = points_a @ np.swapaxes(T_b_a[..., :3, :3], -1, -2) + T_b_a[..., None, :3, 3]
    x, y, z = np.moveaxis(points, -1, 0)
    ranges = np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
    above, below, inside = _rows_around(np.arcsin(z / ranges), view_b.altitude_rad)
    width = view_b.range_m.shape[1]
    left = np.floor((view_b.azimuth_0_rad - np.arctan2(y, x)) * (width / (2 * np.pi))).astype(np.intp) % width
    right = (left + 1) % width
    agrees = np.zeros(ranges.shape, bool)
    for row, column in ((above, left), (above, right), (below, left), (below, right)):
        measured = view_b.range_m[row, column]
        agrees |= (measured > 0) & (np.abs(measured - ranges) <= MARGIN_M)
    return np.count_nonzero(agrees & inside, axis=-1) / points_a.shape[-2]


def overlap(
    view_a: RangeView, view_b: RangeView, T_map_a: np.ndarray, T_map_b: np.ndarray, n_max: int | None = None
) -> float:
    """Overlap of two scans, as defined above; T_map_*: (4, 4) true poses; n_max thins the points."""
    T_b_a = np.linalg.solve(T_map_b, T_map_a)
    a_in_b = share(view_a.points(n_max), view_b, T_b_a)
    b_in_a = share(view_b.points(n_max), view_a, np.linalg.inv(T_b_a))
    return float(0.5 * (a_in_b + b_in_a))


def overlap_matrix(views: list[RangeView], T_map_sensor: np.ndarray, n_max: int) -> np.ndarray:
    """(N, N) float32 overlaps of every pair of N scans of one world; T_map_sensor: (N, 4, 4).

    All scans are thinned to one number of returns, `n_max` or what the emptiest scan has.
    """
    n_points = min(n_max, min(np.count_nonzero(view.range_m) for view in views))
    points = np.stack([view.points(n_points) for view in views])
    T_sensor_map = np.linalg.inv(T_map_sensor)
    shares = [share(points, view, T @ T_map_sensor) for view, T in zip(views, T_sensor_map, strict=True)]
    matrix = np.stack(shares).astype(np.float32)
    np.fill_diagonal(matrix, 1.0)
    return 0.5 * (matrix + matrix.T)


def _rows_around(altitude: np.ndarray, beams: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows just above and below each altitude (clipped), and whether it is in the field of view."""
    below = np.searchsorted(-beams, -altitude)
    last = len(beams) - 1
    half_beam = 0.5 * (beams[0] - beams[-1]) / max(last, 1)
    inside = (altitude <= beams[0] + half_beam) & (altitude >= beams[-1] - half_beam)
    return np.clip(below - 1, 0, last), np.clip(below, 0, last), inside
