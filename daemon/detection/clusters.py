"""Change points to objects by distance-threshold clustering (CDSD III-D)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

VOXEL_M = 0.05  # objects are counted and stored at one point for each voxel: overlapping scans do not add points


def thin(points: np.ndarray) -> np.ndarray:
    """Indices (M,) of one point for each voxel: the first in the order given."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    voxel = np.floor(points / np.float32(VOXEL_M)).astype(np.int64)
    voxel -= voxel.min(axis=0)
    size = voxel.max(axis=0) + 1
    key = (voxel[:, 0] * size[1] + voxel[:, 1]) * size[2] + voxel[:, 2]
    return np.sort(np.unique(key, return_index=True)[1])


def cluster(points: np.ndarray, distance_m: float) -> np.ndarray:
    """Label (N,) of the connected component of each point (N, 3) in the graph of pairs nearer than the distance."""
    pairs = cKDTree(points).query_pairs(distance_m, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    return connected_components(graph, directed=False)[1]
