"""The largest changes from near, before and after: seen from where the robot was, from a little above."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from .plotdata import CloseUp
from .plotstyle import COLOURS, HALO

TILT_RAD = np.deg2rad(25.0)


def draw_close_ups(cells: list[SubFigure], close_ups: list[CloseUp]) -> None:
    """A pair of pictures in a cell for each change."""
    for cell, close_up in zip(cells, close_ups, strict=False):
        change = close_up.change
        cell.suptitle(
            f"{change.id} {change.polarity}, {change.n_points} points",
            color=COLOURS[change.polarity], fontsize=10, fontweight="bold",
        )  # fmt: skip
        before, after = cell.subplots(1, 2)
        _draw_oblique(before, "before", close_up, close_up.before, change.polarity == "disappeared")
        _draw_oblique(after, "after", close_up, close_up.after, change.polarity == "appeared")


def _draw_oblique(axes: Axes, name: str, close_up: CloseUp, cloud: np.ndarray, with_object: bool) -> None:
    change = close_up.change
    half_m = float(np.clip(1.1 * (change.box_max - change.box_min).max(), 1.2, 6.0))
    near = np.abs(cloud - change.centroid.astype(np.float32)).max(axis=1) < 1.6 * half_m
    u, v, depth = _oblique(cloud[near], change.centroid, close_up.eye)
    order = np.argsort(-depth)
    fog = {"cmap": "gray", "vmin": -2.2 * half_m, "vmax": 2.2 * half_m}  # the farther the paler
    axes.scatter(u[order], v[order], s=1.2, c=depth[order], linewidths=0, **fog)
    if with_object:
        u, v, _ = _oblique(change.points, change.centroid, close_up.eye)
        axes.scatter(u, v, s=2.5, color=COLOURS[change.polarity], linewidths=0)
    axes.plot([0.4 * half_m, 0.4 * half_m + 0.5], [-0.93 * half_m] * 2, color="black", linewidth=2, path_effects=HALO)
    axes.text(0.4 * half_m + 0.25, -0.88 * half_m, "0.5 m", fontsize=7, ha="center", path_effects=HALO)
    axes.set(xlim=(-half_m, half_m), ylim=(-half_m, half_m), aspect="equal", xticks=[], yticks=[])
    axes.set_xlabel(name, fontsize=9)


def _oblique(points: np.ndarray, centre: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and away (N,) each, metres, of points (N, 3) seen from the eye's side."""
    ahead = (centre - eye)[:2]
    ahead = ahead / max(np.linalg.norm(ahead), 1e-6)
    right, away = np.array([[ahead[1], -ahead[0]], ahead]) @ (points[:, :2] - centre[:2]).T
    up = points[:, 2] - centre[2]
    seen_up = up * np.cos(TILT_RAD) + away * np.sin(TILT_RAD)
    return right, seen_up, away * np.cos(TILT_RAD) - up * np.sin(TILT_RAD)
