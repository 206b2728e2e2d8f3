"""Fits a sweep to planes: where the sensor was at its end, and how it moved meanwhile.

A rotation takes a tenth of a second, in which a robot on wheels rolls and pitches by some tenths of a degree, faster
than poses from sweep to sweep can tell: deskewed by them, a scan stays bent by 5 cm at 20 m, and a map of bent scans
tilts further and further. So pose, motion and how unsteady that was, eighteen numbers, are fitted together
(Gauss-Newton, point to plane).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from .geometry import inverse
from .sweep import Sweep

MAX_STEPS = 8
SETTLED_M, SETTLED_RAD = 2e-3, np.radians(0.02)  # a smaller step is the last
SCALE_M = 0.1  # of the robust kernel: a point so far from its plane counts a quarter
# Standard deviations of the errors expected in a prediction: of the motion during the sweep, and of the pose at its
# end. They decide only what the planes leave open, as a field without walls does.
MOTION_M, MOTION_RAD = 0.05, np.radians(1.0)
POSE_M, POSE_RAD = 0.3, np.radians(2.5)
# What a robot's own motion bends a sweep by. Left free, the bend also takes for motion what the map ahead, seen from
# afar, is wrong by: front and rear of a sweep would be joined by a hinge, and the map would curl (studied on four
# virtual patrols: a third of it leaves twice the drift, three times as much is a hinge).
BEND_M, BEND_RAD = 0.002, np.radians(0.03)


def _prior() -> np.ndarray:
    """Information (18, 18) on the errors of start and end, and on the bend: x, y, z (m), rotation vector of each."""
    motion, pose, bend = (
        np.diag([metres**-2] * 3 + [radians**-2] * 3)
        for metres, radians in ((MOTION_M, MOTION_RAD), (POSE_M, POSE_RAD), (BEND_M, BEND_RAD))
    )
    none = np.zeros((6, 6))
    return np.block([[motion, -motion, none], [-motion, motion + pose, none], [none, none, bend]])


PRIOR = _prior()


@dataclass(frozen=True, eq=False)
class Planes:
    """For each of N points: a point (N, 3) and the unit normal (N, 3) of its plane, and its weight (N,).

    The weight is the inverse of the variance (m2) across the plane; 0 where the point has no plane. known (N,) bool:
    whether anything is known there, plane or not.
    """

    point: np.ndarray
    normal: np.ndarray
    weight: np.ndarray
    known: np.ndarray


@dataclass(frozen=True, eq=False)
class SweepFit:
    """The steady motion that is nearest to a sweep's, and how well the sweep fits.

    T_map_sensor (4, 4) at its end, T_start_end (4, 4) during it; bend (6,): see Sweep.
    """

    T_map_sensor: np.ndarray
    T_start_end: np.ndarray
    bend: np.ndarray
    known_ratio: float  # share of the sweep's cells that lie where something is known
    residual_m: float  # root mean square distance to their planes of those that have one within the gate


def fit_sweep(
    sweep: Sweep,
    T_map_sensor: np.ndarray,
    T_start_end: np.ndarray,
    planes_at: Callable[[np.ndarray], Planes],
    gate_m: float,
) -> SweepFit:
    """Improve a predicted pose and motion. planes_at: of points (N, 3) in the map."""
    error = np.zeros(18)
    for _ in range(MAX_STEPS):
        local = sweep.at_end(T_start_end, error[12:])
        planes = planes_at(local @ T_map_sensor[:3, :3].T + T_map_sensor[:3, 3])
        normal = planes.normal @ T_map_sensor[:3, :3]
        across = (((planes.point - T_map_sensor[:3, 3]) @ T_map_sensor[:3, :3] - local) * normal).sum(axis=1)
        paired = (planes.weight > 0) & (np.abs(across) < gate_m)
        shapes = np.stack([1 - sweep.phase, sweep.phase, sweep.bow], 1)[paired]
        step = _step(local[paired], shapes, normal[paired], across[paired], planes.weight[paired], error)
        error += step
        start, end = _motion(step[:6]), _motion(step[6:12])
        T_map_sensor = T_map_sensor @ end
        T_start_end = T_start_end @ inverse(start) @ end
        if (np.abs(step.reshape(6, 3)).max(axis=1) < [SETTLED_M, SETTLED_RAD] * 3).all():
            break
    residual_m = float(np.sqrt((across[paired] ** 2).mean())) if paired.any() else float("inf")
    return SweepFit(T_map_sensor, T_start_end, error[12:], float(planes.known.mean()), residual_m)


def _step(
    local: np.ndarray,
    shapes: np.ndarray,
    normal: np.ndarray,
    across: np.ndarray,
    weight: np.ndarray,
    error: np.ndarray,
) -> np.ndarray:
    """One step of Gauss and Newton, (18,): to the poses at start and end and to the bend, in the frame at the end.

    shapes (N, 3): how much each of these moves each of the points.
    """
    by_pose = np.concatenate([normal, np.cross(local, normal)], axis=1)
    jacobian = (shapes[:, :, None] * by_pose[:, None, :]).reshape(-1, 18)
    weighted = jacobian * (weight / (1 + (across / SCALE_M) ** 2) ** 2)[:, None]
    return np.linalg.solve(weighted.T @ jacobian + PRIOR, weighted.T @ across - PRIOR @ error)


def _motion(step: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
    T[:3, 3] = step[:3]
    return T
