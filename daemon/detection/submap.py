"""A submap: the selected scans of a scene as points in the map frame and as depth images from where they were taken."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from . import arrays
from .jit import kernel

MAX_COLUMNS = 1024  # finer images have holes between the returns of a 1024-column scan
MIN_NEIGHBOURS = 5  # returns among 3 x 3 pixels without which nothing is known of a direction


# What a scan saw in the direction of a point: nothing known, past it, it, perhaps it, something before it, no return.
UNKNOWN, THROUGH, AT, GLIMPSED, HIDDEN, OPEN = range(6)


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What one scan saw in each direction from one place.

    T_sensor_map (4, 4) maps map coordinates to the vantage point's frame (z up); slope_edges (H + 1,) float32
    ascending: tangents of the elevations between neighbouring beams, and of the field of view's two ends; depth
    (H, W) float32 metres: the smallest range in each pixel, inf without a return.
    """

    T_sensor_map: np.ndarray
    slope_edges: np.ndarray
    depth: np.ndarray

    def look_at(self, points: np.ndarray, margin_m: float, range_m: float) -> np.ndarray:
        """What the scan saw at the place of each point (N, 3) map frame: (N,) int8, UNKNOWN to OPEN.

        A point's pixel and its eight neighbours are asked, for edges and pose errors. Of at least MIN_NEIGHBOURS
        returns the nearest lies margin behind the point: THROUGH, or within the margin of it: AT. Another one lies
        there, or too few are known: GLIMPSED. All lie before it: HIDDEN. There is none, which is not free space: OPEN.
        UNKNOWN too beyond range_m.
        """
        R, t = self.T_sensor_map[:3, :3], self.T_sensor_map[:3, 3]
        return _look_at(
            points, R.astype(np.float32), t.astype(np.float32), self.slope_edges, self.depth, margin_m, range_m
        )


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

    def around(self, lower: np.ndarray, upper: np.ndarray) -> Submap:
        """The same scans with the points in a box, lower and upper corner (3,)."""
        return self.only(arrays.inside(self.points, lower, upper))


NO_SCANS = Submap(np.empty((0, 3), np.float32), np.empty(0, np.int16), [], np.empty(0, np.int64), np.empty(0, np.int64))


def join(a: Submap, b: Submap) -> Submap:
    """The scans of both."""
    return Submap(
        np.concatenate([a.points, b.points]),
        np.concatenate([a.scan, b.scan + np.int16(len(a.images))]),
        a.images + b.images,
        np.concatenate([a.visit, b.visit]),
        np.concatenate([a.stamp_ns, b.stamp_ns]),
    )


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
    R = T_map_vantage[:3, :3]
    T_sensor_map = np.eye(4)
    T_sensor_map[:3, :3] = R.T
    T_sensor_map[:3, 3] = -R.T @ T_map_vantage[:3, 3]
    return DepthImage(T_sensor_map, edges, _depth(points, edges, min(columns, MAX_COLUMNS)))


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
def _look_at(points, R, t, edges, depth, margin, max_range):
    height, width = depth.shape
    out = np.full(len(points), UNKNOWN, np.int8)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
        row, column, distance = _pixel(x, y, z, edges, width)
        if row < 0 or distance >= max_range:
            continue
        known, nearest, met = 0, np.float32(np.inf), False
        for dr in range(-1, 2):
            r = min(max(row + dr, 0), height - 1)
            for dc in range(-1, 2):
                seen = depth[r, (column + dc) % width]
                if seen < np.inf:
                    known += 1
                    nearest = min(nearest, seen)
                    met = met or abs(seen - distance) <= margin
        if met:
            out[i] = AT if known >= MIN_NEIGHBOURS and abs(nearest - distance) <= margin else GLIMPSED
        elif known == 0:
            out[i] = OPEN
        elif nearest < distance:
            out[i] = HIDDEN
        elif known >= MIN_NEIGHBOURS:
            out[i] = THROUGH
    return out
