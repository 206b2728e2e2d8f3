"""Candidate changes by distance to nearest neighbours, and the noise filter (CDSD III-C). Both exact."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def cells(points: np.ndarray, size_m: float, origin: np.ndarray) -> np.ndarray:
    """Integer key (N,) of the cube of side size_m that each point (N, 3) lies in; equal key = same cube."""
    index = np.floor((points - origin) / np.float32(size_m)).astype(np.int64)
    return (index[:, 0] * 2_000_003 + index[:, 1]) * 2_000_003 + index[:, 2]


def changed(points: np.ndarray, reference: np.ndarray, tau_m: float, n: int) -> np.ndarray:
    """Which points (N, 3) lie on average farther than tau from their n nearest points of the reference (M, 3).

    Most are settled without a search: n reference points in a point's own cube of side tau / sqrt(3) are all
    nearer than tau. For the rest a mean within tau needs the n-th neighbour within n * tau, so the search stops
    there; and only reference points in cubes that touch that reach go into the tree.
    """
    if len(points) == 0 or len(reference) < n:
        return np.ones(len(points), dtype=bool)
    origin = np.minimum(points.min(axis=0), reference.min(axis=0))
    out = np.zeros(len(points), dtype=bool)
    rest = ~_crowded(points, reference, tau_m / np.sqrt(3.0), n, origin)
    if not rest.any():
        return out
    near = _within_reach(reference, points[rest], n * tau_m, origin)
    if near.sum() < n:
        out[rest] = True
        return out
    tree = cKDTree(reference[near], balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points[rest], k=n, distance_upper_bound=n * tau_m)
    out[rest] = distance.reshape(rest.sum(), n).mean(axis=1) > tau_m
    return out


def dense_enough(points: np.ndarray, rho_m: float, n: int) -> np.ndarray:
    """Noise filter: which candidates (N, 3) lie on average within rho of their n nearest fellow candidates."""
    if len(points) <= n:
        return np.zeros(len(points), dtype=bool)
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points, k=n + 1, distance_upper_bound=n * rho_m)
    return distance[:, 1:].mean(axis=1) < rho_m


def _crowded(points: np.ndarray, reference: np.ndarray, size_m: float, n: int, origin: np.ndarray) -> np.ndarray:
    """Which points share a cube with at least n reference points."""
    keys, count = np.unique(cells(reference, size_m, origin), return_counts=True)
    keys = keys[count >= n]
    return _contains(keys, cells(points, size_m, origin))


def _within_reach(reference: np.ndarray, points: np.ndarray, reach_m: float, origin: np.ndarray) -> np.ndarray:
    """Which reference points lie in the 27 cubes of side reach around some point: a superset of those in reach."""
    corner = origin - np.float32(reach_m)
    occupied = np.unique(cells(points, reach_m, corner))
    steps = np.array([-1, 0, 1], dtype=np.int64)
    shift = (steps[:, None, None] * 2_000_003 + steps[None, :, None]) * 2_000_003 + steps[None, None, :]
    wanted = np.unique(occupied[:, None] + shift.reshape(1, -1))
    return _contains(wanted, cells(reference, reach_m, corner))


def _contains(sorted_keys: np.ndarray, keys: np.ndarray) -> np.ndarray:
    if len(sorted_keys) == 0:
        return np.zeros(len(keys), dtype=bool)
    at = np.minimum(np.searchsorted(sorted_keys, keys), len(sorted_keys) - 1)
    return sorted_keys[at] == keys
