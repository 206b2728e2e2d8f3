"""Registers a scan to stored scans (GICP, small_gicp), and says what the result is worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import small_gicp

from .geometry import transform

SCAN_VOXEL_RATIO = 1.2  # a scan is thinner than the reference it is registered to
NEIGHBOURS = 10  # for the normals of a scan
SURFACE_NEIGHBOURS = 12
# An OS1-128 in a street leaves half as many. Leaves, rain or noise all around would leave ten times as many, and a
# registration would take half a minute.
MAX_SCAN_POINTS, MAX_SURFACE_POINTS = 40_000, 200_000
STEEP = 0.7  # cosine of a normal with the vertical below which a surface stands upright
HIT_M = 0.3  # an upright point this near to the surface is met


@dataclass(frozen=True, eq=False)
class Surface:
    """Stored scans as GICP wants them: points with normals and covariances, map frame, and a tree over them."""

    cloud: small_gicp.PointCloud
    tree: small_gicp.KdTree


@dataclass(frozen=True, eq=False)
class Match:
    """A pose T_map_sensor (4, 4) of a scan and how well the scan lies on the surface there."""

    T_map_sensor: np.ndarray
    inlier_ratio: float  # share of the scan within the gate
    upright_ratio: float  # share of what stands upright in it that is met; ground fits anywhere, walls and trees do not
    n_upright: int
    residual_m: float  # root mean square distance of the inliers to the surface


def surface_of(points: np.ndarray, voxel_m: float) -> Surface:
    """Points (N, 3) float32 metres, map frame, thinned to voxels."""
    return Surface(*_thinned(points.astype(np.float64), voxel_m, SURFACE_NEIGHBOURS, MAX_SURFACE_POINTS))


def scan_cloud(points: np.ndarray, voxel_m: float, range_m: float) -> small_gicp.PointCloud:
    """Returns (N, 3) float32 metres, sensor frame, within range and thinned for a surface of such voxels."""
    near = points[(points**2).sum(axis=1) < range_m**2].astype(np.float64)
    return _thinned(near, voxel_m * SCAN_VOXEL_RATIO, NEIGHBOURS, MAX_SCAN_POINTS)[0]


def _thinned(
    points: np.ndarray, voxel_m: float, neighbours: int, at_most: int
) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
    """One point a voxel, and of these at most so many, with normals and covariances; and a tree over them."""
    thin = small_gicp.voxelgrid_sampling(points, voxel_m, 1).points()[:, :3]
    cloud = small_gicp.PointCloud(thin[:: max(1, -(-len(thin) // at_most))])
    tree = small_gicp.KdTree(cloud, 1)
    small_gicp.estimate_normals_covariances(cloud, tree, neighbours, 1)
    return cloud, tree


def align(scan: small_gicp.PointCloud, surface: Surface, T_map_sensor: np.ndarray, gate_m: float) -> np.ndarray:
    """T_map_sensor (4, 4) improved from a first guess; pairs farther apart than the gate do not pull."""
    return small_gicp.align(
        surface.cloud,
        scan,
        surface.tree,
        T_map_sensor,
        registration_type="GICP",
        max_correspondence_distance=gate_m,
        num_threads=1,
    ).T_target_source


def judge(T_map_sensor: np.ndarray, scan: small_gicp.PointCloud, surface: Surface, gate_m: float) -> Match:
    """How well a scan at T_map_sensor (4, 4) lies on the surface."""
    in_map = transform(T_map_sensor, scan.points()[:, :3])
    index, squared = (np.asarray(found) for found in surface.tree.batch_nearest_neighbor_search(in_map, num_threads=1))
    upright = np.abs(scan.normals()[:, :3] @ T_map_sensor[2, :3]) < STEEP
    n_upright = int(upright.sum())
    upright_ratio = float((squared[upright] < HIT_M**2).mean()) if n_upright else 0.0
    paired = squared < gate_m**2
    if not paired.any():
        return Match(T_map_sensor, 0.0, upright_ratio, n_upright, float("inf"))
    at = index[paired]
    off = ((in_map[paired] - surface.cloud.points()[at, :3]) * surface.cloud.normals()[at, :3]).sum(axis=1)
    return Match(T_map_sensor, float(paired.mean()), upright_ratio, n_upright, float(np.sqrt((off**2).mean())))
