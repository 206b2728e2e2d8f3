"""Which scans represent a scene best: OptMap's objective (Thorne et al., arXiv 2512.07775), maximised greedily."""

from __future__ import annotations

import numpy as np


def representation_loss(distances: np.ndarray, weights: np.ndarray, chosen: list[int]) -> float:
    """L_cebc(E with 0) of CDSD section III-B: weighted mean distance to the nearest chosen descriptor.

    distances (N, N) between unit descriptors, clipped at 1 (the auxiliary zero vector is 1 away from all);
    weights (N,) sum to 1. Lies in [0, 1].
    """
    nearest = distances[:, chosen].min(axis=1) if chosen else np.ones(len(weights))
    return float(weights @ nearest)


def descriptor_distances(descriptors: np.ndarray) -> np.ndarray:
    """Euclidean distances (N, N) float64 between unit vectors (N, D), clipped at 1 by the zero vector."""
    cosines = descriptors.astype(np.float64) @ descriptors.T.astype(np.float64)
    return np.minimum(np.sqrt(np.maximum(2.0 - 2.0 * cosines, 0.0)), 1.0)


def travel_weights(descriptors: np.ndarray, visit: np.ndarray) -> np.ndarray:
    """Weights (N,) summing to 1: distance of each descriptor to the one before it in the same visit.

    A parked robot thus adds no weight. The first of a visit weighs like the mean of the visits' steps.
    """
    steps = np.linalg.norm(np.diff(descriptors.astype(np.float64), axis=0), axis=1)
    same_visit = visit[1:] == visit[:-1]
    weights = np.concatenate([[0.0], np.where(same_visit, steps, 0.0)])
    first = np.concatenate([[True], ~same_visit])
    weights[first] = weights[~first].mean() if (~first).any() else 1.0
    total = weights.sum()
    return weights / total if total > 0 else np.full(len(weights), 1.0 / len(weights))


def select(descriptors: np.ndarray, visit: np.ndarray, k: int) -> np.ndarray:
    """Indices, ascending, of at most k scans that represent all N best: max Gamma(E) = L({0}) - L(E with 0).

    descriptors (N, 256) unit, in order of time; visit (N,) the visit each scan belongs to. Gamma is monotone and
    submodular, so the greedy choice reaches at least 1 - 1/e = 63 % of the optimum; OptMap's sieve, made for
    streams of 36 thousand scans, guarantees 50 % and is slower at a scene's size. Ties go to the earlier scan:
    the choice is the same each time.
    """
    distances = descriptor_distances(descriptors)
    weights = travel_weights(descriptors, visit)
    nearest = np.ones(len(weights))
    chosen: list[int] = []
    for _ in range(min(k, len(weights))):
        gains = weights @ np.maximum(nearest[:, None] - distances, 0.0)
        gains[chosen] = -1.0
        best = int(np.argmax(gains))
        chosen.append(best)
        nearest = np.minimum(nearest, distances[:, best])
    return np.sort(np.array(chosen, dtype=np.int64))
