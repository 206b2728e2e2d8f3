"""Which scans represent a scene best: OptMap's objective (Thorne et al., arXiv 2512.07775), maximised greedily."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def representation_loss(apart: np.ndarray, weights: np.ndarray, chosen: list[int]) -> float:
    """L_cebc(E with 0) of CDSD section III-B: weighted mean distance to the nearest chosen scan.

    apart (N, N) of unshared(); the auxiliary zero vector is 1 away from all. weights (N,) sum to 1. Lies in [0, 1].
    """
    nearest = apart[:, chosen].min(axis=1) if chosen else np.ones(len(weights))
    return float(weights @ nearest)


def unshared(
    descriptors: np.ndarray, model_id: np.ndarray, overlap_at: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """The objective's distances (N, N) float64: the part of two scans that is expected not to overlap.

    descriptors (N, D) unit, by models (N,); overlap_at: the calibration from their distance to overlap. Descriptors of
    two models cannot be compared: such scans are taken to share nothing, and each model's are represented by its own.
    """
    cosines = descriptors.astype(np.float64) @ descriptors.T.astype(np.float64)
    apart = 1.0 - overlap_at(np.sqrt(np.maximum(2.0 - 2.0 * cosines, 0.0)))
    np.fill_diagonal(apart, 0.0)
    return np.where(model_id[:, None] == model_id, apart, 1.0)


def travel_weights(apart: np.ndarray, visit: np.ndarray) -> np.ndarray:
    """Weights (N,) summing to 1: what each scan does not share with the one before it in the same visit.

    A parked robot thus adds no weight. The first of a visit weighs like the mean of the visits' steps.
    """
    same_visit = visit[1:] == visit[:-1]
    weights = np.concatenate([[0.0], np.where(same_visit, np.diagonal(apart, 1), 0.0)])
    first = np.concatenate([[True], ~same_visit])
    weights[first] = weights[~first].mean() if (~first).any() else 1.0
    total = weights.sum()
    return weights / total if total > 0 else np.full(len(weights), 1.0 / len(weights))


def select(apart: np.ndarray, visit: np.ndarray, k: int) -> np.ndarray:
    """Indices, ascending, of at most k scans that represent all N best: max Gamma(E) = L({0}) - L(E with 0).

    apart (N, N) of unshared(), in order of time; visit (N,) the visit each scan belongs to. Gamma is monotone and
    submodular, so the greedy choice reaches at least 1 - 1/e = 63 % of the optimum; OptMap's sieve, made for
    streams of 36 thousand scans, guarantees 50 % and is slower at a scene's size. Ties go to the earlier scan:
    the choice is the same each time.
    """
    weights = travel_weights(apart, visit)
    nearest = np.ones(len(weights))
    chosen: list[int] = []
    for _ in range(min(k, len(weights))):
        gains = weights @ np.maximum(nearest[:, None] - apart, 0.0)
        gains[chosen] = -1.0
        best = int(np.argmax(gains))
        chosen.append(best)
        nearest = np.minimum(nearest, apart[:, best])
    return np.sort(np.array(chosen, dtype=np.int64))
