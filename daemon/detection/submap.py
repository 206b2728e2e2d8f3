"""A submap: the selected scans of a scene as points in the map frame and as depth images from where they were taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import minimum_filter, uniform_filter

MAX_COLUMNS = 1024  # finer images have holes between the returns of a 1024-column scan
MIN_NEIGHBOURS = 5  # returns among 3 x 3 pixels without which nothing is known of a direction


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What one scan saw in each direction from one place.

    T_sensor_map (4, 4) maps map coordinates to the vantage point's frame (z up); altitude_edges (H - 1,)
    ascending radians between neighbouring beams; nearest (H, W) float32 metres: the smallest range among each
    pixel's 3 x 3 neighbours, NaN where fewer than MIN_NEIGHBOURS of them hold a return. No return is not free
    space.
    """

    T_sensor_map: np.ndarray
    altitude_edges: np.ndarray
    nearest: np.ndarray

    def look_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Range of points (N, 3) map frame from the vantage point, and the range seen in that direction.

        Both (N,) float32 metres; the second is NaN where nothing is known, out of the field of view too.
        """
        local = points @ self.T_sensor_map[:3, :3].T.astype(np.float32) + self.T_sensor_map[:3, 3].astype(np.float32)
        row, col, distance = _pixels(local, self.altitude_edges, self.nearest.shape[1])
        inside = row >= 0
        seen = np.full(len(points), np.nan, dtype=np.float32)
        seen[inside] = self.nearest[row[inside], col[inside]]
        return distance, seen


@dataclass(frozen=True, eq=False)
class Submap:
    """Scans of one scene: points (N, 3) float32 map frame, and scan (N,) int16, the index of each point's scan.

    For each of the S scans: its depth image, visit (S,) the number of its visit, stamp_ns (S,) int64 its time.
    """

    points: np.ndarray
    scan: np.ndarray
    images: list[DepthImage]
    visit: np.ndarray
    stamp_ns: np.ndarray

    def only(self, keep: np.ndarray) -> Submap:
        """The same scans with some of the points, keep (N,) bool."""
        return replace(self, points=self.points[keep], scan=self.scan[keep])


def depth_image(points: np.ndarray, T_map_vantage: np.ndarray, altitude_rad: np.ndarray, columns: int) -> DepthImage:
    """The depth image of one scan from its own returns.

    points (N, 3) float32 metres in the vantage frame, taken within one sweep and deskewed to one instant;
    altitude_rad (H,) the sensor's beams; columns per turn.
    """
    altitudes = np.sort(altitude_rad.astype(np.float64))
    edges = 0.5 * (altitudes[1:] + altitudes[:-1])
    columns = min(columns, MAX_COLUMNS)
    row, col, distance = _pixels(points, edges, columns)
    inside = row >= 0
    depth = np.full((len(altitudes), columns), np.inf, dtype=np.float32)
    np.minimum.at(depth, (row[inside], col[inside]), distance[inside])
    known = uniform_filter(np.isfinite(depth).astype(np.float32), 3, mode=("nearest", "wrap")) * 9.0
    nearest = minimum_filter(depth, 3, mode=("nearest", "wrap"))
    nearest[known < MIN_NEIGHBOURS - 0.5] = np.nan
    R = T_map_vantage[:3, :3]
    T_sensor_map = np.eye(4)
    T_sensor_map[:3, :3] = R.T
    T_sensor_map[:3, 3] = -R.T @ T_map_vantage[:3, 3]
    return DepthImage(T_sensor_map, edges, nearest)


def _pixels(local: np.ndarray, edges: np.ndarray, columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row (-1 above or below the field of view), column and range of points (N, 3) in the vantage frame."""
    flat2 = local[:, 0] ** 2 + local[:, 1] ** 2
    distance = np.sqrt(flat2 + local[:, 2] ** 2)
    altitude = np.arctan2(local[:, 2], np.sqrt(flat2))
    row = np.searchsorted(edges, altitude)
    # Clamping what lies beyond the outermost beams into them would invent sight where there is none.
    half_beam = 0.5 * np.median(np.diff(edges))
    row[(altitude < edges[0] - 3 * half_beam) | (altitude > edges[-1] + 3 * half_beam)] = -1
    turn = np.arctan2(local[:, 1], local[:, 0]) * (columns / (2 * np.pi))
    col = np.floor(turn).astype(np.int64) % columns
    return row, col, distance
