"""A walled yard seen by an ideal OS1, in closed form: scans for tests that need no ray caster."""

import numpy as np

HALF_X_M, HALF_Y_M, WALL_M, SENSOR_HEIGHT_M = 15.0, 10.0, 4.0, 1.5


def beams(count: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """(H,) pixel shifts and (H,) altitudes of an OS1 with this many beams and columns."""
    altitude = np.deg2rad(np.linspace(21.2, -21.2, 128)[:: 128 // count]).astype(np.float32)
    return np.tile(np.array([24, 16, 8, 0]) * columns // 1024, count // 4), altitude


def scan(
    count: int = 64,
    columns: int = 512,
    x: float = 2.0,
    y: float = -1.0,
    yaw: float = 0.0,
    hidden: tuple[float, float] | None = None,
) -> np.ndarray:
    """(count, columns) uint32 mm, staggered: the yard from (x, y) facing yaw; azimuths `hidden` are empty."""
    shift, altitude = beams(count, columns)
    aligned = (np.arange(columns)[None, :] + shift[:, None]) % columns
    azimuth = -aligned * (2 * np.pi / columns) + yaw + 1e-4  # no beam runs along a wall
    ahead, left = np.cos(azimuth), np.sin(azimuth)
    flat = np.minimum(
        np.where(ahead > 0, HALF_X_M - x, -HALF_X_M - x) / ahead,
        np.where(left > 0, HALF_Y_M - y, -HALF_Y_M - y) / left,
    )
    rise = flat * np.tan(altitude)[:, None]
    ranges = flat / np.cos(altitude)[:, None]
    on_ground = rise < -SENSOR_HEIGHT_M
    ranges = np.where(on_ground, SENSOR_HEIGHT_M / np.sin(np.maximum(-altitude, 1e-3))[:, None], ranges)
    ranges = np.where(rise > WALL_M - SENSOR_HEIGHT_M, 0.0, ranges)
    if hidden is not None:
        ranges = np.where(
            (np.mod(azimuth, 2 * np.pi) >= hidden[0]) & (np.mod(azimuth, 2 * np.pi) < hidden[1]), 0.0, ranges
        )
    return np.rint(ranges * 1e3).astype(np.uint32)


def pose(x: float, y: float, yaw: float = 0.0) -> np.ndarray:
    """(4, 4) T_map_sensor of a scan taken there."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, SENSOR_HEIGHT_M
    return T
