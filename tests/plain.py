"""The steps of an instance written plainly with numpy and scipy: what the compiled ones must agree with.

Tests compare them on small arrays, tests/benchmarks/instances.py on whole submaps, where it also times both.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from revisitd.daemon.detection import ground as g
from revisitd.daemon.detection.submap import (
    AT,
    GLIMPSED,
    HIDDEN,
    MAX_COLUMNS,
    MIN_NEIGHBOURS,
    OPEN,
    THROUGH,
    UNKNOWN,
    DepthImage,
    slope_edges,
)
from revisitd.daemon.geometry import column_phase, deskew, fraction_of, inverse, transform
from revisitd.daemon.submap_build import MID_SWEEP
from revisitd.daemon.views import OWN_BODY_M


def only(submap, keep):
    return replace(submap, points=submap.points[keep], scan=submap.scan[keep])


def changed(points, reference, tau_m, n):
    if len(reference) < n:
        return np.ones(len(points), bool)
    distance, _ = cKDTree(reference).query(points, k=n)
    return distance.reshape(len(points), n).mean(axis=1) > tau_m


def dense_enough(points, rho_m, n):
    if len(points) <= n:
        return np.zeros(len(points), bool)
    distance, _ = cKDTree(points).query(points, k=n + 1)
    return distance[:, 1:].mean(axis=1) < rho_m


def scan_view(scan, sensor, range_m):
    points = deskew(
        sensor.points(scan.range_mm), column_phase(scan.column_ns, scan.column_valid), scan.T_start_end, MID_SWEEP
    )
    valid = (scan.range_mm > OWN_BODY_M * 1e3) & scan.column_valid
    T_map_mid = scan.T_map_sensor @ inverse(scan.T_start_end) @ fraction_of(scan.T_start_end, MID_SWEEP)
    T_map_vantage = T_map_mid.copy()
    T_map_vantage[:3, 3] += T_map_mid[:3, :3] @ sensor.lidar_origin
    image = depth_image(points[valid] - sensor.lidar_origin, T_map_vantage, sensor.altitude_rad, sensor.shape[1])
    near = valid & (scan.range_mm < range_m * 1e3)
    return scan, transform(T_map_mid, points[near]).astype(np.float32), image


def depth_image(points, T_map_vantage, altitude_rad, columns):
    edges, columns = slope_edges(altitude_rad), min(columns, MAX_COLUMNS)
    row, col, distance = _pixels(points, edges, columns)
    inside = row >= 0
    depth = np.full((len(altitude_rad), columns), np.inf, dtype=np.float32)
    np.minimum.at(depth, (row[inside], col[inside]), distance[inside])
    return DepthImage(inverse(T_map_vantage), edges, depth)


def look_at(image, points, margin_m, range_m):
    height, width = image.depth.shape
    row, col, distance = _pixels(transform(image.T_sensor_map, points), image.slope_edges, width)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    around = np.stack([image.depth[np.clip(row + i, 0, height - 1), (col + j) % width] for i, j in steps])
    known, nearest = np.isfinite(around).sum(axis=0), around.min(axis=0, initial=np.inf)
    cases = [
        (row < 0) | (distance >= range_m),
        (np.abs(nearest - distance) <= margin_m) & (known >= MIN_NEIGHBOURS),
        (np.abs(around - distance) <= margin_m).any(axis=0),
        known == 0,
        nearest < distance,
        known >= MIN_NEIGHBOURS,
    ]
    return np.select(cases, [UNKNOWN, AT, GLIMPSED, OPEN, HIDDEN, THROUGH], UNKNOWN)


def _pixels(local, edges, columns):
    distance = np.linalg.norm(local, axis=1).astype(np.float32)
    slope = local[:, 2] / np.hypot(local[:, 0], local[:, 1])
    row = np.searchsorted(edges[1:-1], slope)
    row[(slope < edges[0]) | (slope > edges[-1])] = -1
    col = np.floor(np.arctan2(local[:, 1], local[:, 0]) * (columns / (2 * np.pi))).astype(np.int64) % columns
    return row, col, distance


def segment_ground(points, centre, sigmas, min_sigma_m):
    """Each point asks for the plane of its own bin; bins have exact rims."""
    bins, n_bins = g._polar_bins(points, centre)
    low = low_points(points)
    ground = g._consistent(g._fit_planes(low, g._polar_bins(low, centre)[0], n_bins))
    plane_of_bin, known = ground.nearest(g._bin_centres(points, bins, n_bins))
    limit = np.where(known, sigmas * np.maximum(ground.sigma[plane_of_bin], min_sigma_m), -np.inf)
    at = plane_of_bin[bins]
    height = ((points - ground.mean[at]) * ground.normal[at]).sum(axis=1)
    return height < limit[bins], ground


def low_points(points):
    index = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / np.float32(g.CELL_M)).astype(np.int64)
    width = int(index[:, 1].max()) + 1
    cell = index[:, 0] * width + index[:, 1]
    n_cells = (int(index[:, 0].max()) + 1) * width
    lowest = np.full(n_cells, np.inf, dtype=np.float32)
    np.minimum.at(lowest, cell, points[:, 2])
    keep = points[:, 2] < lowest[cell] + np.float32(g.CELL_DEPTH_M)
    cell, kept = cell[keep], points[keep]
    count = np.bincount(cell, minlength=n_cells)
    filled = count > 0
    sums = np.stack([np.bincount(cell, kept[:, i], n_cells)[filled] for i in range(3)], axis=1)
    return sums / count[filled, None]
