"""The line that a patrol follows."""

import numpy as np

STEP_M = 0.1
MIN_RADIUS_M = 4.5


class Route:
    """A smooth plane curve, world frame; closed (a loop) or open (driven there and back)."""

    def __init__(self, xy: np.ndarray, closed: bool):
        """xy: (N, 2) metres, dense; a closed curve does not repeat its first point."""
        ring = np.concatenate([xy, xy[:1]]) if closed else xy
        s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
        self.length_m, self.closed = float(s[-1]), closed
        self._s = np.linspace(0, self.length_m, int(self.length_m / STEP_M) + 1)
        self._ring = np.stack([np.interp(self._s, s, ring[:, k]) for k in (0, 1)], 1)
        self.xy = self._ring[:-1] if closed else self._ring  # (M, 2) metres, every STEP_M
        step = (
            np.roll(self._ring[:-1], -1, 0) - np.roll(self._ring[:-1], 1, 0)
            if closed
            else np.gradient(self._ring, axis=0)
        )
        yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        self._turn = 2 * np.pi * np.round((yaw[-1] - yaw[0]) / (2 * np.pi)) if closed else 0.0
        self._yaw = np.append(yaw, yaw[0] + self._turn) if closed else yaw

    def at(self, s) -> tuple[np.ndarray, np.ndarray]:
        """s: (...) metres along (a loop wraps) -> xy (..., 2), heading (...) rad, continuous over laps."""
        s = np.asarray(s, float)
        lap = np.floor(s / self.length_m) if self.closed else 0.0
        s = s - lap * self.length_m
        xy = np.stack([np.interp(s, self._s, self._ring[:, k]) for k in (0, 1)], -1)
        return xy, np.interp(s, self._s, self._yaw) + lap * self._turn

    def beside(self, s, offset_m) -> np.ndarray:
        """The point offset_m to the left of the route at s: (..., 2)."""
        xy, yaw = self.at(s)
        return xy + np.asarray(offset_m)[..., None] * np.stack([-np.sin(yaw), np.cos(yaw)], -1)


def loop(rng: np.random.Generator, length_m: float) -> Route:
    """A closed route: a rounded block or a free curve, of the length asked; start, heading and sense vary."""
    for _ in range(100):
        xy = _block(rng) if rng.random() < 0.5 else _blob(rng)
        xy = xy * length_m / np.linalg.norm(np.diff(np.concatenate([xy, xy[:1]]), axis=0), axis=1).sum()
        if rng.random() < 0.5:
            xy = xy[::-1]
        angle = rng.uniform(0, 2 * np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        route = Route(np.roll(xy, rng.integers(len(xy)), axis=0) @ turn.T, closed=True)
        if _radius(route) > min(MIN_RADIUS_M, 0.11 * length_m):
            return route
    raise ValueError(f"no loop of {length_m} m without a sharp corner")


def line(rng: np.random.Generator, length_m: float) -> Route:
    """An open route, slightly curved."""
    s = np.linspace(0, 1, 400)
    bend = sum(rng.normal(0, 0.06 / k) * np.sin(np.pi * k * s + rng.uniform(0, 6)) for k in (1, 2))
    xy = np.stack([s, bend - bend[0]], 1)
    xy *= length_m / np.linalg.norm(np.diff(xy, axis=0), axis=1).sum()
    angle = rng.uniform(0, 2 * np.pi)
    return Route(xy @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).T, closed=False)


def _blob(rng) -> np.ndarray:
    theta = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    r = 1 + sum(rng.normal(0, 0.22 / k) * np.cos(k * theta + rng.uniform(0, 6)) for k in (2, 3, 4, 5))
    return np.stack([r * np.cos(theta) * rng.uniform(1.0, 1.5), r * np.sin(theta)], 1)


def _block(rng) -> np.ndarray:
    """A rectangle whose corners are rounded by a power law, with a bow in its sides."""
    theta = np.linspace(0, 2 * np.pi, 1500, endpoint=False)
    power = rng.uniform(3.0, 4.5)
    r = (np.abs(np.cos(theta)) ** power + np.abs(np.sin(theta)) ** power) ** (-1 / power)
    r *= 1 + rng.normal(0, 0.03) * np.cos(3 * theta + rng.uniform(0, 6))
    return np.stack([r * np.cos(theta) * rng.uniform(1.0, 1.6), r * np.sin(theta)], 1)


def _radius(route: Route) -> float:
    """Smallest radius of curvature over 1 m of the route, metres."""
    _, yaw = route.at(np.arange(0, route.length_m, 1.0))
    return 1.0 / max(np.abs(np.diff(yaw)).max(), 1e-6)
