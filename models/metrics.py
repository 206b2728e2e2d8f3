"""How well a distance between scans tells their overlap, and how well it finds places again."""

from __future__ import annotations

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.stats import spearmanr

N_KNOTS = 33
# Pairs above this overlap are weighed alike: between worlds nearly all pairs share nothing.
N_OVERLAP_BINS = 10


def pairs(matrix: np.ndarray) -> np.ndarray:
    """(N, N) symmetric -> (N (N - 1) / 2,): each unordered pair once, in a fixed order."""
    return matrix[np.triu_indices(len(matrix), 1)]


def descriptor_distances(descriptors: np.ndarray, others: np.ndarray | None = None) -> np.ndarray:
    """(N, D), (M, D) unit vectors -> (N, M) float64 Euclidean distances."""
    cosine = descriptors.astype(np.float64) @ (descriptors if others is None else others).astype(np.float64).T
    return np.sqrt(np.maximum(2.0 - 2.0 * cosine, 0.0))


def rank_agreement(distance: np.ndarray, overlap: np.ndarray) -> float:
    """Spearman's rank correlation of falling distance with growing overlap; (P,), (P,) -> 1 is perfect."""
    return float(-spearmanr(distance, overlap).statistic)


def calibration_curve(distance: np.ndarray, overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expected overlap as a falling function of distance, as two lists of knots for linear interpolation.

    Isotonic regression of bin means; the bins hold equal numbers of pairs of each tenth of overlap, so that
    the many pairs without overlap do not take all knots. The curve begins at (0, 1).
    """
    weight = balanced_weights(overlap)
    order = np.argsort(distance)
    distance, overlap, weight = distance[order], overlap[order], weight[order]
    edges = np.searchsorted(np.cumsum(weight) / weight.sum(), np.linspace(0, 1, N_KNOTS)[1:-1])
    parts = [part for part in np.split(np.arange(len(order)), np.unique(edges)) if part.size]
    knots = np.array([distance[part].mean() for part in parts])
    means = np.array([overlap[part].mean() for part in parts])
    falling = isotonic_regression(means, weights=[part.size for part in parts], increasing=False).x
    return np.concatenate(([0.0], knots)), np.concatenate(([1.0], np.minimum(falling, 1.0)))


def balanced_weights(overlap: np.ndarray) -> np.ndarray:
    """(P,) weights that give each tenth of overlap the same sum (empty tenths aside), mean 1."""
    tenth = np.minimum((overlap * N_OVERLAP_BINS).astype(int), N_OVERLAP_BINS - 1)
    count = np.bincount(tenth, minlength=N_OVERLAP_BINS)
    weight = 1.0 / count[tenth]
    return weight / weight.mean()


def recall(distance: np.ndarray, is_place: np.ndarray, k: int) -> tuple[float, int]:
    """Part of the queries for which one of the k nearest entries is the same place, and how many queries
    had one.

    distance: (Q, M) from queries to entries; is_place: (Q, M) bool.
    """
    asked = is_place.any(axis=1)
    nearest = np.argpartition(distance[asked], k - 1, axis=1)[:, :k]
    return float(np.take_along_axis(is_place[asked], nearest, axis=1).any(axis=1).mean()), int(asked.sum())
