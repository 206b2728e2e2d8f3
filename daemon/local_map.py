"""The last key scans as one map of Gaussians: where the next one is, finer than KISS-ICP's voxels say (VGICP)."""

from __future__ import annotations

import numpy as np
import small_gicp

from .geometry import inverse, rotation_angle_rad

CLEAR_EVERY = 5  # scans between two sweeps of what was not seen for long
MAX_MOVE_M = 0.3  # between two key scans KISS-ICP is right to some centimetres; more is a wrong match
MAX_TURN_DEG = 2.5
MIN_INLIERS = 0.5  # share of the scan


class LocalMap:
    """Gaussians of voxel_m; those that the last n_scans scans did not touch are dropped, so its size is bounded."""

    def __init__(self, voxel_m: float, n_scans: int):
        self._voxel_m = voxel_m
        self._n_scans = n_scans
        self.clear()

    def clear(self) -> None:
        """Forget all: the map's frame has moved."""
        self._gaussians = small_gicp.GaussianVoxelMap(self._voxel_m)
        self._gaussians.set_lru(horizon=self._n_scans, clear_cycle=CLEAR_EVERY)
        self._empty = True

    def refine(self, source: small_gicp.PointCloud, predicted: np.ndarray) -> np.ndarray:
        """Pose (4, 4) of a scan with covariances, by the scans before it; the predicted one where they say nothing."""
        if self._empty:
            return predicted
        result = small_gicp.align(
            self._gaussians, source, predicted, max_correspondence_distance=2 * self._voxel_m, num_threads=1
        )
        correction = inverse(predicted) @ result.T_target_source
        moved, turned = np.linalg.norm(correction[:3, 3]), np.degrees(rotation_angle_rad(correction))
        believed = result.num_inliers >= MIN_INLIERS * source.size() and moved < MAX_MOVE_M and turned < MAX_TURN_DEG
        return result.T_target_source if believed else predicted

    def add(self, source: small_gicp.PointCloud, T_map_sensor: np.ndarray) -> None:
        """One more scan, where it was found to be."""
        self._gaussians.insert(source, T_map_sensor)
        self._empty = False
