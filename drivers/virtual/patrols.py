"""How the sensor is carried: passes over a route, as a pose at any time."""

from dataclasses import dataclass

import numpy as np

from .mesh import rotation
from .routes import Route
from .terrain import Terrain

REST_S = 1.5  # standing still before the first pass and between passes
TURN_RATE_RAD_S = np.deg2rad(50)
ACCELERATION_M_S2 = 0.7
SETTLE_M = 8.0  # over which a pass reaches its own lateral offset
WHEELBASE_M = 1.2
STEP_S = 0.02


@dataclass(frozen=True)
class Pass:
    """One traversal of the route."""

    offset_m: float  # to the left of the route's line, seen in the route's sense
    speed_m_s: float
    reverse: bool = False


class Patrol:
    """Passes driven one after another; `pose` is smooth but for the shake of a rolling vehicle."""

    def __init__(
        self,
        route: Route,
        terrain: Terrain,
        passes: list[Pass],
        rng: np.random.Generator,
        height_m: float = 1.2,
    ):
        self._route, self._terrain, self._sensor_height = route, terrain, height_m
        self.passes = passes
        self._t, self._along, self._offset, self._face, self.pass_start_s = _drive(route, passes, rng)
        self.duration_s = float(self._t[-1])
        self._shake = [(rng.uniform(1.0, 6.0, 5), rng.uniform(0, 2 * np.pi, 5), rng.normal(0, 1, 5)) for _ in range(3)]

    def pass_at(self, t_s: float) -> int:
        """Index of the pass under way at t_s (seconds from the start); it changes while the robot stands."""
        return max(0, int(np.searchsorted(self.pass_start_s, t_s, side="right")) - 1)

    def along(self, t_s) -> np.ndarray:
        """t_s -> metres along the route."""
        return np.interp(t_s, self._t, self._along)

    def pose(self, t_s) -> np.ndarray:
        """t_s: (...) seconds from the start -> T_world_sensor (..., 4, 4) float64."""
        t_s = np.asarray(t_s, float)
        along, offset = (np.interp(t_s, self._t, values) for values in (self._along, self._offset))
        _, tangent = self._route.at(along)
        xy = self._route.beside(along, offset)
        yaw = tangent + np.interp(t_s, self._t, self._face)
        ahead = 0.5 * WHEELBASE_M * np.stack([np.cos(yaw), np.sin(yaw)], -1)
        across = np.stack([-ahead[..., 1], ahead[..., 0]], -1)
        front, rear, left, right = (self._terrain.slope_height(xy + d) for d in (ahead, -ahead, across, -across))
        moving = np.clip(np.abs(np.interp(t_s, self._t, np.gradient(self._along, self._t))) / 1.0, 0.03, 1.0)
        roll, pitch, bounce = (moving * self._wobble(k, t_s) for k in range(3))
        pitch = -np.arctan2(front - rear, WHEELBASE_M) + np.deg2rad(0.2) * pitch
        roll = np.arctan2(left - right, WHEELBASE_M) + np.deg2rad(0.2) * roll
        pose = np.zeros((*t_s.shape, 4, 4))
        pose[..., :3, :3] = rotation(yaw, pitch, roll)
        pose[..., :2, 3] = xy
        pose[..., 2, 3] = 0.25 * (front + rear + left + right) + 0.005 * bounce
        pose[..., :3, 3] += self._sensor_height * pose[..., :3, 2]
        pose[..., 3, 3] = 1.0
        return pose

    def _wobble(self, axis: int, t_s: np.ndarray) -> np.ndarray:
        """About unit variance, from a few frequencies of the chassis."""
        hz, phase, size = self._shake[axis]
        return np.sin(2 * np.pi * t_s[..., None] * hz + phase) @ (size * np.sqrt(2.0 / np.sum(size**2)))


def _drive(route: Route, passes: list[Pass], rng):
    """Tables over time: t, metres along, lateral offset, heading off the route's; when each pass starts."""
    along = route.length_m if passes[0].reverse else 0.0
    face = np.pi if passes[0].reverse else 0.0
    rows, starts = [_hold(0.0, REST_S, along, passes[0].offset_m, face)], [0.0]
    for one in passes:
        if len(rows) > 1:
            starts.append(rows[-1][-1, 0] - 0.5 * REST_S)
            if one.reverse == (round(face / np.pi) % 2 == 0):
                rows.append(_turn(*rows[-1][-1], face + np.pi))
        t, begin, offset, face = rows[-1][-1]
        # On a loop laps count on, so that the heading stays continuous.
        end = begin + (-1 if one.reverse else 1) * route.length_m
        rows.append(_travel(t, begin, end, offset, one, face, rng))
        t, _, offset, _ = rows[-1][-1]
        rows.append(_hold(t, REST_S, end, offset, face))
    table = np.concatenate(rows)
    table = table[np.append(True, np.diff(table[:, 0]) > 1e-9)]
    return *table.T, np.array(starts)


def _hold(t, duration, along, offset, face) -> np.ndarray:
    times = t + np.arange(0, duration + STEP_S / 2, STEP_S)
    return np.stack([times, *(np.full_like(times, v) for v in (along, offset, face))], 1)


def _turn(t, along, offset, face, target) -> np.ndarray:
    """Turning in place, eased at both ends."""
    duration = 1.5 * abs(target - face) / TURN_RATE_RAD_S
    times = np.arange(0, duration + STEP_S / 2, STEP_S)
    angle = face + (target - face) * _ease(times / duration)
    return np.stack([t + times, *(np.full_like(times, v) for v in (along, offset)), angle], 1)


def _ease(share: np.ndarray) -> np.ndarray:
    """0 .. 1 -> 0 .. 1 with no slope at both ends."""
    share = np.clip(share, 0, 1)
    return share * share * (3 - 2 * share)


def _travel(t, begin, end, offset, one: Pass, face, rng) -> np.ndarray:
    """From begin to end: speeding up, cruising with a changing speed, braking."""
    length, sense = abs(end - begin), np.sign(end - begin)
    u = np.linspace(0, length, int(length / 0.02) + 2)
    wave = 0.18 * np.sin(2 * np.pi * u / rng.uniform(15, 35) + rng.uniform(0, 6))
    room = np.minimum(u, length - u) + 0.02
    speed = np.minimum(one.speed_m_s * (1 + wave), np.sqrt(2 * ACCELERATION_M_S2 * room))
    clock = np.concatenate([[0.0], np.cumsum(np.diff(u) * 2 / (speed[1:] + speed[:-1]))])
    times = np.arange(0, clock[-1], STEP_S)
    done = np.interp(times, clock, u)
    settled = _ease(done / SETTLE_M)
    wander = 0.15 * np.sin(2 * np.pi * done / rng.uniform(20, 40)) * settled * _ease((length - done) / SETTLE_M)
    lateral = offset + (one.offset_m - offset) * settled + wander
    heading = face + sense * np.arctan(np.gradient(lateral, done))
    return np.stack([t + times, begin + sense * done, lateral, heading], 1)
