"""Key scans as one map of planes, to which another sweep can be fitted."""

from __future__ import annotations

import numpy as np

from .sweep_fit import Planes
from .voxels import Moments, pooled, voxel_keys

MIN_POINTS = 6  # of a voxel: fewer make no plane
MIN_WIDTH_M = 0.06  # standard deviation along a plane's shorter side; one beam's trace is a line, and has no normal
MAX_THICKNESS_M = 0.15  # standard deviation across it; thicker is foliage, or an edge
FLATNESS = 2.0  # how many times wider than thick a plane is at least
NOISE_M = 0.02  # of a range and of a pose: a plane is not known better

# Means are of the map, which may be kilometres across; the rest is of a voxel.
VOXEL = np.dtype(
    [
        ("last_scan", np.int32),
        ("count", np.float32),
        ("mean", np.float64, 3),
        ("covariance", np.float32, (3, 3)),
        ("normal", np.float32, 3),
        ("weight", np.float32),
    ]
)


class PlaneMap:
    """In each voxel the plane through all the points that fell into it."""

    def __init__(self, voxel_m: float):
        self._voxel_m = voxel_m
        self._scans = 0
        self._keys = np.empty(0, np.int64)  # in order
        self._voxels = np.empty(0, VOXEL)

    def __len__(self) -> int:
        """Voxels in the map."""
        return len(self._keys)

    @property
    def means(self) -> np.ndarray:
        """(N, 3) float64 metres, map frame: the mean of the points of each voxel."""
        return self._voxels["mean"]

    def planes_at(self, points: np.ndarray) -> Planes:
        """The plane of the voxel that each of the points (N, 3), map frame, lies in."""
        if len(self) == 0:
            return Planes(points, np.zeros_like(points), np.zeros(len(points)), np.zeros(len(points), bool))
        keys = voxel_keys(points, self._voxel_m)
        at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        voxels, known = self._voxels[at], self._keys[at] == keys
        return Planes(voxels["mean"], voxels["normal"], np.where(known, voxels["weight"], 0.0), known)

    def add(self, cells: Moments) -> None:
        """One more scan, in the map."""
        keys, group = np.unique(voxel_keys(cells.mean, self._voxel_m), return_inverse=True)
        at = self._room_for(keys)
        voxels = self._voxels[at]
        parts = Moments(*(np.concatenate([voxels[name], getattr(cells, name)]) for name in Moments.NAMES))
        united = pooled(parts, np.concatenate([np.arange(len(at)), group]))
        for name in Moments.NAMES:
            voxels[name] = getattr(united, name)
        voxels["normal"], voxels["weight"] = _planes(united)
        voxels["last_scan"] = self._scans
        self._voxels[at] = voxels
        self._scans += 1

    def forget(self, n_scans: int, n_voxels: int) -> None:
        """Keep what the last so many scans touched, and of that at most so many voxels, the latest."""
        last_scan = self._voxels["last_scan"]
        oldest = self._scans - n_scans
        if len(last_scan) > n_voxels:
            oldest = max(oldest, 1 + np.partition(last_scan, -n_voxels)[-n_voxels])
        self._keys, self._voxels = self._keys[last_scan >= oldest], self._voxels[last_scan >= oldest]

    def _room_for(self, keys: np.ndarray) -> np.ndarray:
        """Where the voxels of these keys (N,), in order, are from now on: (N,) indices; new ones are empty."""
        at = np.searchsorted(self._keys, keys)
        new = np.append(self._keys, -1)[at] != keys
        self._keys = np.insert(self._keys, at[new], keys[new])
        self._voxels = np.insert(self._voxels, at[new], np.zeros(1, VOXEL))
        return np.searchsorted(self._keys, keys)


def _planes(moments: Moments) -> tuple[np.ndarray, np.ndarray]:
    """Normals (N, 3) and weights (N,), 1 / m2, of the planes that fit best; 0 where there is none."""
    variances, axes = np.linalg.eigh(moments.covariance)
    thickness, width = np.sqrt(np.maximum(variances[:, :2], 0.0)).T
    flat = (width > MIN_WIDTH_M) & (thickness < MAX_THICKNESS_M) & (width > FLATNESS * thickness)
    weight = np.where(flat & (moments.count >= MIN_POINTS), 1.0 / (thickness**2 + NOISE_M**2), 0.0)
    return axes[:, :, 0], weight
