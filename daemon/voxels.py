"""Points summed up by voxels: how many, their mean and their spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BITS = 20  # of a voxel's index along each axis: a million voxels either way is 100 km at 0.1 m
UPPER = np.triu_indices(3)


@dataclass(frozen=True, eq=False)
class Moments:
    """Of each of N groups of points: count (N,), mean (N, 3), covariance (N, 3, 3); metres."""

    NAMES = ("count", "mean", "covariance")

    count: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def voxel_keys(points: np.ndarray, voxel_m: float) -> np.ndarray:
    """Which voxel each of the points (N, 3) lies in: (N,) int64, at most 61 bits, equal for equal voxels only."""
    i, j, k = np.floor(points.T / voxel_m).astype(np.int64) + (1 << (BITS - 1))
    return (i << (2 * BITS)) | (j << BITS) | k


def moments_of(points: np.ndarray, group: np.ndarray) -> Moments:
    """The moments of points (N, 3), each of a group (N,) from 0 on."""
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, points[:, axis]) for axis in range(3)], 1) / count[:, None]
    off = points - mean[group]
    covariance = np.empty((len(count), 3, 3))
    for a, b in zip(*UPPER, strict=True):
        covariance[:, a, b] = covariance[:, b, a] = np.bincount(group, off[:, a] * off[:, b]) / count
    return Moments(count, mean, covariance)


def pooled(parts: Moments, group: np.ndarray) -> Moments:
    """The moments of groups of groups: each of the N parts belongs to one group (N,) from 0 on."""
    count = np.bincount(group, parts.count)
    share = parts.count / count[group]
    mean = np.stack([np.bincount(group, share * parts.mean[:, axis]) for axis in range(3)], 1)
    off = parts.mean - mean[group]
    covariance = np.empty((len(count), 3, 3))
    for a, b in zip(*UPPER, strict=True):
        spread = parts.covariance[:, a, b] + off[:, a] * off[:, b]
        covariance[:, a, b] = covariance[:, b, a] = np.bincount(group, share * spread)
    return Moments(count, mean, covariance)
