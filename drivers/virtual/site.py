"""Which ground is taken: a raster that keeps things from standing in each other."""

import numpy as np

CELL_M = 0.4


class Site:
    """Occupancy of the ground, world frame. Points are (K, 2) metres; outside the world all is taken."""

    def __init__(self, bounds: np.ndarray):
        """bounds: (2, 2) metres, two opposite corners."""
        self._low = bounds[0]
        shape = np.ceil((bounds[1] - bounds[0]) / CELL_M).astype(int)
        self._solid = np.zeros(shape, bool)  # something stands here
        self._view = np.zeros(shape, bool)  # kept open, so that a change can be seen from the route

    def is_free(self, points: np.ndarray, also_view: bool = True) -> bool:
        """Whether nothing stands at any of the points, nor (also_view) would block a view kept open."""
        index, inside = self._index(points)
        if not inside.all():
            return False
        taken = self._solid[index] | self._view[index] if also_view else self._solid[index]
        return not taken.any()

    def take(self, points: np.ndarray) -> None:
        """Mark the points as built over."""
        self._mark(self._solid, points)

    def keep_open(self, points: np.ndarray) -> None:
        """Mark the points as a view to keep open."""
        self._mark(self._view, points)

    def _mark(self, raster: np.ndarray, points: np.ndarray) -> None:
        index, inside = self._index(points)
        raster[tuple(axis[inside] for axis in index)] = True

    def _index(self, points: np.ndarray):
        cell = np.floor((np.asarray(points) - self._low) / CELL_M).astype(int)
        inside = ((cell >= 0) & (cell < self._solid.shape)).all(-1)
        cell = np.clip(cell, 0, np.array(self._solid.shape) - 1)
        return (cell[..., 0], cell[..., 1]), inside


def rectangle(xy, yaw: float, length: float, width: float, margin: float = 0.2) -> np.ndarray:
    """Points covering a rectangle about xy, its length along yaw: (K, 2) metres."""
    half = np.array([length, width]) / 2 + margin
    axes = [np.linspace(-h, h, int(2 * h / (0.7 * CELL_M)) + 2) for h in half]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return grid @ turn.T + np.asarray(xy)


def disc(xy, radius: float) -> np.ndarray:
    """Points covering a disc about xy: (K, 2) metres."""
    square = rectangle((0.0, 0.0), 0.0, 2 * radius, 2 * radius, margin=0.0)
    return square[np.linalg.norm(square, axis=1) <= radius + 0.1] + np.asarray(xy)


def strip(start, end, width: float = 0.8) -> np.ndarray:
    """Points covering the straight strip from start to end: (K, 2) metres."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = end - start
    return rectangle((start + end) / 2, np.arctan2(along[1], along[0]), float(np.linalg.norm(along)), width, margin=0.0)
