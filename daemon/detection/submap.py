"""A submap: the selected scans of a scene as points in the map frame and as depth images from where they were taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from . import arrays
from .jit import kernel

MAX_COLUMNS = 1024  # finer images have holes between the returns of a 1024-column scan
MIN_NEIGHBOURS = 5  # returns among 3 x 3 pixels without which nothing is known of a direction


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What one scan saw in each direction from one place.

    T_sensor_map (4, 4) maps map coordinates to the vantage point's frame (z up); slope_edges (H + 1,) float32
    ascending: tangents of the elevations between neighbouring beams, and of the field of view's two ends; nearest
    (H, W) float32 metres: the smallest range among each pixel's 3 x 3 neighbours, NaN where fewer than
    MIN_NEIGHBOURS of them hold a return. No return is not free space.
    """

    T_sensor_map: np.ndarray
    slope_edges: np.ndarray
    nearest: np.ndarray

    def look_at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Range of points (N, 3) map frame from the vantage point, and the range seen in that direction.

        Both (N,) float32 metres; the second is NaN where nothing is known, out of the field of view too.
        """
        R, t = self.T_sensor_map[:3, :3], self.T_sensor_map[:3, 3]
        return _look_at(points, R.astype(np.float32), t.astype(np.float32), self.slope_edges, self.nearest)


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
        points, scan = arrays.keep(self.points, self.scan, keep)
        return replace(self, points=points, scan=scan)


def slope_edges(altitude_rad: np.ndarray) -> np.ndarray:
    """Where one beam's pixels end and the next one's begin, as tangents of elevation: (H + 1,) float32 ascending.

    altitude_rad (H,), any order. The image ends one and a half beams beyond the outermost ones: what lies farther
    out is not seen, and clamping it into them would invent sight where there is none.
    """
    altitudes = np.sort(altitude_rad.astype(np.float64))
    between = 0.5 * (altitudes[1:] + altitudes[:-1])
    beyond = 1.5 * np.median(np.diff(between))
    return np.tan(np.concatenate([[between[0] - beyond], between, [between[-1] + beyond]])).astype(np.float32)


def depth_image(points: np.ndarray, T_map_vantage: np.ndarray, altitude_rad: np.ndarray, columns: int) -> DepthImage:
    """The depth image of one scan from its own returns.

    points (N, 3) float32 metres in the vantage frame, taken within one sweep and deskewed to one instant;
    altitude_rad (H,) the sensor's beams; columns per turn.
    """
    edges = slope_edges(altitude_rad)
    nearest = _nearest_around(_depth(points, edges, min(columns, MAX_COLUMNS)))
    R = T_map_vantage[:3, :3]
    T_sensor_map = np.eye(4)
    T_sensor_map[:3, :3] = R.T
    T_sensor_map[:3, 3] = -R.T @ T_map_vantage[:3, 3]
    return DepthImage(T_sensor_map, edges, nearest)


@kernel
def _pixel(x, y, z, edges, columns):
    """Row (-1 above or below the field of view), column and range of a point in the vantage frame."""
    flat = np.sqrt(x * x + y * y)
    distance = np.sqrt(flat * flat + z * z)
    column = int(np.floor(np.arctan2(y, x) * np.float32(columns / (2 * np.pi)))) % columns
    slope = z / flat
    if not edges[0] <= slope <= edges[-1]:
        return -1, column, distance
    low, high = 0, edges.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] < slope:
            low = middle
        else:
            high = middle
    return low, column, distance


@kernel
def _depth(points, edges, columns):
    """The smallest range of the points in each pixel, inf where there is none."""
    depth = np.full((edges.size - 1, columns), np.inf, np.float32)
    for i in range(len(points)):
        row, column, distance = _pixel(points[i, 0], points[i, 1], points[i, 2], edges, columns)
        if row >= 0 and distance < depth[row, column]:
            depth[row, column] = distance
    return depth


@kernel
def _nearest_around(depth):
    """The smallest of 3 x 3 pixels, NaN where too few are finite; columns go round, the outer rows count twice."""
    height, width = depth.shape
    nearest = np.empty_like(depth)
    for row in range(height):
        for column in range(width):
            known, least = 0, np.float32(np.inf)
            for i in range(-1, 2):
                r = min(max(row + i, 0), height - 1)
                for j in range(-1, 2):
                    value = depth[r, (column + j) % width]
                    if value < np.inf:
                        known += 1
                        least = min(least, value)
            nearest[row, column] = least if known >= MIN_NEIGHBOURS else np.nan
    return nearest


@kernel
def _look_at(points, R, t, edges, nearest):
    distance = np.empty(len(points), np.float32)
    seen = np.full(len(points), np.nan, np.float32)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        row, column, distance[i] = _pixel(x, y, z, edges, nearest.shape[1])
        if row >= 0:
            seen[i] = nearest[row, column]
    return distance, seen
