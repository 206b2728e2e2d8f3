"""Ground by polar bins with Gaussian planes (CDSD III-C, after Patchwork++), and the ground filter B1/B2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .arrays import bounds
from .jit import kernel

BIN_M = 2.5  # ring width and arc length of a bin: kerbs and slopes stay within a plane's spread
MAX_RADIUS_M = 60.0
CELL_M = 0.25  # planes are fitted to one low point for each cell: a bag's many returns weigh no more than its place
CELL_DEPTH_M = 0.08  # a cell's low point is the mean of its returns so far above the lowest
SEED_HEIGHT_M = 0.4  # above a bin's lowest points; a 15 % slope rises so much over a bin
FIT_DISTANCE_M = 0.12
MIN_BIN_CELLS = 10  # of the hundred in a bin
MIN_UPRIGHT = 0.85  # cosine of 32 degrees
MAX_STEP_M = 0.35  # a bin's plane so far above what its neighbours say is a roof or a hedge, not ground
FLAT_HEIGHT_M = 0.3  # a level sheet this near to the ground is ground: a bump, a kerb, a puddle's rim
FLAT_SIGMA_M = 0.04  # thickness of a sheet, one sigma
FLAT_RATIO = 0.25  # ... and against its width
MAX_BORROW_M = 6.0  # a bin without a plane of its own uses the nearest one within this


@dataclass(frozen=True, eq=False)
class Ground:
    """Planes of the bins with ground: mean (B, 3), upward normal (B, 3), covariance (B, 3, 3), sigma (B,), metres."""

    mean: np.ndarray
    normal: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    _tree: cKDTree | None

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Index of the bin whose mean is nearest in the plane (N,), and whether it is near enough to speak (N,)."""
        if self._tree is None:
            return np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=bool)
        distance, index = self._tree.query(points[:, :2])
        return index, distance <= MAX_BORROW_M

    def is_under(self, points: np.ndarray, sigmas: float, min_sigma_m: float) -> np.ndarray:
        """Which of a few points (N, 3) are ground by the nearest plane: (N,) bool; not where no ground is known."""
        index, known = self.nearest(points)
        out = np.zeros(len(points), dtype=bool)
        at = index[known]
        height = ((points[known] - self.mean[at]) * self.normal[at]).sum(axis=1)
        out[known] = height < sigmas * np.maximum(self.sigma[at], min_sigma_m)
        return out


def segment_ground(
    points: np.ndarray, centre: np.ndarray, sigmas: float, min_sigma_m: float
) -> tuple[np.ndarray, Ground]:
    """Which points (N, 3) float32 (map frame, z roughly up) are ground, and the planes that say so.

    A point is ground if its Mahalanobis distance along the plane's normal is below `sigmas`; whatever lies under
    the plane is ground too (reflections in water). centre (2,): where the polar bins are centred; a bin's rim is
    drawn in cells of CELL_M. Returns labels (N,) bool and the Ground.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=bool), _ground(*np.zeros((4, 0, 3)))
    lower, upper = bounds(points)
    corner, n_cells = lower[:2], ((upper - lower)[:2] / np.float32(CELL_M)).astype(np.int64) + 1
    cell, low = _low_points(points, corner, n_cells)
    bins, n_bins = _polar_bins(low, centre)
    ground = _consistent(_fit_planes(low, bins, n_bins))
    if not len(ground.mean):
        return np.zeros(len(points), dtype=bool), ground
    # One plane for each bin, looked up by cell: a tree query for each of a million points would cost a second.
    plane_of_bin, known = ground.nearest(_bin_centres(low, bins, n_bins))
    normal = ground.normal[plane_of_bin]
    level = (normal * (ground.mean[plane_of_bin] - [*corner, 0.0])).sum(axis=1)
    limit = np.where(known, level + sigmas * np.maximum(ground.sigma[plane_of_bin], min_sigma_m), -np.inf)
    planes = np.full((n_cells.prod(), 4), -np.inf, dtype=np.float32)
    planes[cell] = np.column_stack([normal, limit])[bins]
    return _under(points, corner, n_cells[1], planes), ground


def is_ground_like(points: np.ndarray, ground: Ground, c1_m: float, c2: float) -> bool:
    """Ground filter: does an object's Gaussian lie in and look like the nearest ground (B1 < c1 and B2 < c2)?"""
    mean = points.mean(axis=0, dtype=np.float64)
    index, known = ground.nearest(mean[None])
    if not known[0]:
        return False
    sigma_g = ground.covariance[index[0]] + 1e-6 * np.eye(3)
    sigma_o = np.cov(points.T.astype(np.float64)) + 1e-6 * np.eye(3)
    b1 = abs((mean - ground.mean[index[0]]) @ ground.normal[index[0]])
    log_det = [np.linalg.slogdet(m)[1] for m in (0.5 * (sigma_g + sigma_o), sigma_g, sigma_o)]
    b2 = 0.5 * (log_det[0] - 0.5 * (log_det[1] + log_det[2]))
    return bool((b1 < c1_m and b2 < c2) or (b1 < FLAT_HEIGHT_M and _is_flat(sigma_o)))


def _is_flat(covariance: np.ndarray) -> bool:
    """Whether points lie as a level sheet: B2 compares sizes too, and a patch of ground is smaller than its bin."""
    variance, axes = np.linalg.eigh(covariance)
    thickness, width = np.sqrt(variance[0]), np.sqrt(variance[1])
    return bool(thickness < FLAT_SIGMA_M and thickness < FLAT_RATIO * width and abs(axes[2, 0]) > MIN_UPRIGHT)


def _polar_bins(points: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, int]:
    """Bin (N,) of each point on rings of equal width whose sectors have about equal arcs; and the number of bins."""
    dx, dy = points[:, 0] - np.float32(centre[0]), points[:, 1] - np.float32(centre[1])
    n_rings = int(MAX_RADIUS_M / BIN_M)
    ring = np.minimum((np.sqrt(dx * dx + dy * dy) / BIN_M).astype(np.int64), n_rings - 1)
    sectors = np.maximum(np.round(2 * np.pi * (np.arange(n_rings) + 0.5)).astype(np.int64), 4)
    first = np.concatenate([[0], np.cumsum(sectors)])
    turn = np.arctan2(dy, dx) / np.float32(2 * np.pi) + np.float32(0.5)
    sector = np.minimum((turn * sectors[ring]).astype(np.int64), sectors[ring] - 1)
    return first[ring] + sector, int(first[-1])


def _bin_centres(points: np.ndarray, bins: np.ndarray, n_bins: int) -> np.ndarray:
    count = np.maximum(np.bincount(bins, minlength=n_bins), 1)
    return np.stack([np.bincount(bins, points[:, i], n_bins) / count for i in range(2)], axis=1)


def _low_points(points: np.ndarray, corner: np.ndarray, n_cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cells (M,) that hold returns, and one point (M, 3) for each: the mean of its lowest ones."""
    count, sums = _low_sums(points, corner, n_cells[0], n_cells[1])
    cell = np.flatnonzero(count)
    return cell, sums[cell] / count[cell, None]


@kernel
def _cell(point, corner, width):
    per_m = np.float32(1.0 / CELL_M)
    return np.int64((point[0] - corner[0]) * per_m) * width + np.int64((point[1] - corner[1]) * per_m)


@kernel
def _low_sums(points, corner, height, width):
    """Number and sum of the returns in each cell that lie within CELL_DEPTH_M of its lowest one."""
    lowest = np.full(height * width, np.inf, np.float32)
    for i in range(len(points)):
        cell = _cell(points[i], corner, width)
        lowest[cell] = min(lowest[cell], points[i, 2])
    count = np.zeros(height * width, np.int64)
    sums = np.zeros((height * width, 3), np.float64)
    for i in range(len(points)):
        cell = _cell(points[i], corner, width)
        if points[i, 2] < lowest[cell] + np.float32(CELL_DEPTH_M):
            count[cell] += 1
            for axis in range(3):
                sums[cell, axis] += points[i, axis]
    return count, sums


@kernel
def _under(points, corner, width, planes):
    """Which points lie under their cell's limit; planes (cells, 4): normal, and limit along it from the corner."""
    out = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        plane = planes[_cell(points[i], corner, width)]
        height = (points[i, 0] - corner[0]) * plane[0] + (points[i, 1] - corner[1]) * plane[1] + points[i, 2] * plane[2]
        out[i] = height < plane[3]
    return out


def _fit_planes(points: np.ndarray, bins: np.ndarray, n_bins: int) -> Ground:
    """A plane for each bin through its low points, re-fitted to what lies near it."""
    low = _lowest(points[:, 2], bins, n_bins)
    keep = points[:, 2] < (low[bins] + SEED_HEIGHT_M)
    for _ in range(3):
        mean, covariance, count = _moments(points[keep], bins[keep], n_bins)
        eigenvalue, eigenvector = np.linalg.eigh(covariance)
        normal = eigenvector[:, :, 0] * np.where(eigenvector[:, 2:3, 0] < 0, -1.0, 1.0)
        height = ((points - mean[bins]) * normal[bins]).sum(axis=1)
        keep = np.abs(height) < FIT_DISTANCE_M
    good = (count >= MIN_BIN_CELLS) & (normal[:, 2] > MIN_UPRIGHT)
    sigma = np.sqrt(np.maximum(eigenvalue[:, 0], 0.0))
    return _ground(mean[good], normal[good], covariance[good], sigma[good])


def _lowest(z: np.ndarray, bins: np.ndarray, n_bins: int) -> np.ndarray:
    """A low but robust height for each bin: the 10 % quantile (stray returns lie below the ground)."""
    order = np.lexsort((z, bins))
    count = np.bincount(bins, minlength=n_bins)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    low = np.full(n_bins, np.inf)
    filled = count > 0
    low[filled] = z[order[(start + count // 10)[filled]]]
    return low


def _moments(points: np.ndarray, bins: np.ndarray, n_bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count = np.bincount(bins, minlength=n_bins)
    weight = 1.0 / np.maximum(count, 1)
    origin = points.mean(axis=0, dtype=np.float64) if len(points) else np.zeros(3)
    p = points.astype(np.float64) - origin  # second moments of map coordinates far from zero would cancel
    mean = np.stack([np.bincount(bins, p[:, i], n_bins) for i in range(3)], axis=1) * weight[:, None]
    covariance = np.empty((n_bins, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            second = np.bincount(bins, p[:, i] * p[:, j], n_bins) * weight - mean[:, i] * mean[:, j]
            covariance[:, i, j] = covariance[:, j, i] = second
    return mean + origin, covariance, count


def _consistent(ground: Ground) -> Ground:
    """Without the bins that stand above what their neighbours' planes say (car roofs, hedges, walls)."""
    for _ in range(2):
        if len(ground.mean) < 9:
            return ground
        _, neighbours = ground._tree.query(ground.mean[:, :2], k=9)
        to_bin = ground.mean[:, None, :] - ground.mean[neighbours[:, 1:]]
        above = np.median((to_bin * ground.normal[neighbours[:, 1:]]).sum(axis=2), axis=1)
        good = above < MAX_STEP_M
        ground = _ground(ground.mean[good], ground.normal[good], ground.covariance[good], ground.sigma[good])
    return ground


def _ground(mean: np.ndarray, normal: np.ndarray, covariance: np.ndarray, sigma: np.ndarray) -> Ground:
    return Ground(mean, normal, covariance, sigma, cKDTree(mean[:, :2]) if len(mean) else None)
