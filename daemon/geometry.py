"""Rigid transforms: small helpers on (4, 4) float64 matrices. `T_a_b` maps coordinates of b into a."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def inverse(T: np.ndarray) -> np.ndarray:
    """Inverse of rigid transforms (..., 4, 4)."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", R_t, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def transform(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) under T (4, 4); keeps the points' dtype."""
    R = T[:3, :3].astype(points.dtype)
    return points @ R.T + T[:3, 3].astype(points.dtype)


def rotation_angle_rad(T: np.ndarray) -> float:
    """Angle of T's rotation, radians."""
    return float(Rotation.from_matrix(T[:3, :3]).magnitude())


def fraction_of(T: np.ndarray, s: np.ndarray | float) -> np.ndarray:
    """The motion T (4, 4) done to the fraction s, at constant velocity: (..., 4, 4) for s of shape (...).

    Rotation vector and translation are scaled apart, which for one sweep's motion (degrees, decimetres)
    differs from the screw motion by less than a millimetre.
    """
    s = np.asarray(s, dtype=np.float64)
    rotvec = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    out = np.zeros(s.shape + (4, 4))
    out[..., :3, :3] = Rotation.from_rotvec(s.reshape(-1, 1) * rotvec).as_matrix().reshape(s.shape + (3, 3))
    out[..., :3, 3] = s[..., None] * T[:3, 3]
    out[..., 3, 3] = 1.0
    return out


def deskew(points: np.ndarray, column_phase: np.ndarray, T_start_end: np.ndarray, to: float = 1.0) -> np.ndarray:
    """Points of a sweep as seen from one instant of it.

    points (H, W, 3) float32, metres, each column in the sensor frame of its own time; column_phase (W,) from
    0 (sweep's start) to 1 (end); T_start_end (4, 4) the sensor's motion during the sweep; `to` the phase of
    the instant asked for. Returns (H, W, 3) float32.
    """
    T_start_columns = fraction_of(T_start_end, column_phase)
    T_to_columns = inverse(fraction_of(T_start_end, to)) @ T_start_columns
    R = T_to_columns[:, :3, :3].astype(np.float32)
    t = T_to_columns[:, :3, 3].astype(np.float32)
    return np.matmul(points.transpose(1, 0, 2), R.transpose(0, 2, 1)).transpose(1, 0, 2) + t


def column_phase(column_ns: np.ndarray, column_valid: np.ndarray) -> np.ndarray:
    """Phase of each column within its sweep, (W,) float64: 0 at the first valid column, 1 at the last.

    Lost columns have no time of their own (the sensor reports zero) and get phase 1; they hold no returns.
    """
    times = column_ns[column_valid]
    first, last = times.min(), times.max()
    phase = np.ones(len(column_ns))
    if last > first:
        phase[column_valid] = (times - first) / (last - first)
    return phase
