"""A picture of the stored results: the map from above with its changes, and the largest of them from near."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from scipy.ndimage import distance_transform_edt, median_filter

from ..storage.changerows import ChangeObject
from ..storage.rows import SceneRow
from .closeups import draw_close_ups
from .hull import convex_hull
from .plotdata import MapPicture, gather
from .plotstyle import COLOURS, HALO

MARKERS = {"appeared": "o", "disappeared": "s"}
VISIT_COLOURS = ("#9fd3a4", "#3a9e57", "#00471f")  # first, second, later
VISIT_NAMES = ("first time here", "second time", "third or later")
MAP_IN, CELL_IN, HEADING_IN, DPI = 11.0, (4.8, 2.75), 1.0, 150
N_CLOSE_UPS = 4
MAX_LABELS = 40


def plot_map(data_dir: Path, out_png: Path) -> None:
    """Draw the map with the most scans of a data directory. Raises DataDirError where there is none, OSError."""
    picture, close_ups = gather(data_dir, N_CLOSE_UPS)
    lower, upper = _extent(picture)
    figure, map_part, cells = _layout((upper - lower)[1] / (upper - lower)[0], len(close_ups))
    _draw_map(map_part.subplots(), picture, lower, upper)
    map_part.legend(handles=_legend(picture), loc="outside lower center", ncol=4, frameon=False, fontsize=9)
    draw_close_ups(cells, close_ups)
    figure.suptitle(_title(picture), x=0.01, ha="left", fontsize=15, fontweight="bold")
    figure.savefig(out_png, format="png")


def _layout(aspect: float, n_cells: int) -> tuple[Figure, Figure | SubFigure, list[SubFigure]]:
    """A figure, its part for the map, and a cell for each close-up: below a wide map, beside any other."""
    cell_width_in, cell_height_in = CELL_IN
    below = aspect < 0.6
    width_in = MAP_IN + cell_width_in * below
    height_in = float(np.clip(width_in * aspect, 4.0, 12.0)) + HEADING_IN
    if n_cells == 0:
        figure = Figure(figsize=(width_in, height_in), dpi=DPI, layout="constrained")
        return figure, figure, []
    if below:
        figure = Figure(figsize=(width_in, height_in + cell_height_in), dpi=DPI, layout="constrained")
        map_part, row = figure.subfigures(2, 1, height_ratios=[height_in, cell_height_in])
        return figure, map_part, list(row.subfigures(1, N_CLOSE_UPS, squeeze=False).flat)
    height_in = max(height_in, N_CLOSE_UPS * cell_height_in)
    figure = Figure(figsize=(width_in + cell_width_in, height_in), dpi=DPI, layout="constrained")
    map_part, column = figure.subfigures(1, 2, width_ratios=[width_in, cell_width_in])
    return figure, map_part, list(column.subfigures(N_CLOSE_UPS, 1, squeeze=False).flat)


def _title(picture: MapPicture) -> str:
    n = len(picture.changes)
    changes = {0: "No change", 1: "1 change"}.get(n, f"{n} changes")
    n_scenes = len(picture.scenes)
    return f"{changes} found in {n_scenes} scene{'s' if n_scenes != 1 else ''}"


def _subtitle(picture: MapPicture) -> str:
    path = picture.trajectory
    steps = np.linalg.norm(np.diff(path.T_map_sensor[:, :3, 3], axis=0), axis=1)
    length_m = steps[path.session[1:] == path.session[:-1]].sum()
    start = datetime.fromtimestamp(picture.sessions[0].started_host_ns / 1e9, timezone.utc)
    n_scans = len(path.scan_id)
    text = f"{length_m:.0f} m of path, {n_scans} key scans, {picture.sensor}, run of {start:%Y-%m-%d %H:%M} UTC"
    return text + (f"; map {picture.map_id}, one of {picture.n_maps}" if picture.n_maps > 1 else "")


# The map from above ---------------------------------------------------------------------------------------------------


def _draw_map(axes: Axes, picture: MapPicture, lower: np.ndarray, upper: np.ndarray) -> None:
    axes.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal")
    axes.set(xlabel="x in metres", ylabel="y in metres")
    axes.set_title(_subtitle(picture), loc="left", fontsize=10)
    image = _floor_plan(picture.points, lower, upper)
    box = (lower[0], upper[0], lower[1], upper[1])
    axes.imshow(image, extent=box, origin="lower", cmap="gray", vmin=0, vmax=1, interpolation="antialiased")
    _draw_scenes(axes, picture.scenes)
    _draw_trajectory(axes, picture)
    _draw_changes(axes, picture.changes, upper - lower)
    _draw_scale(axes, lower, upper)


def _extent(picture: MapPicture) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (2,) of what is worth showing: path and changes, and some surroundings."""
    centroids = [change.centroid[:2] for change in picture.changes]
    shown = np.vstack([picture.trajectory.T_map_sensor[:, :2, 3], *centroids])
    lower, upper = shown.min(axis=0) - 12.0, shown.max(axis=0) + 12.0
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    half = np.maximum(half, half.max() * 0.35)  # a straight street is no thin strip
    return centre - half, centre + half


def _floor_plan(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Grey image (rows y upwards, columns x), 0..1: dark where things stand, pale where ground was seen.

    Only what is 0.4 to 2.5 m above the ground is dark, so that no canopy hides the street below it.
    """
    inside = ((points[:, :2] > lower) & (points[:, :2] < upper)).all(axis=1)
    points = points[inside]
    cell_m = max(0.1, (upper - lower).max() / 1500)
    shape = tuple(np.ceil((upper - lower) / cell_m).astype(int)[::-1])
    row, column = ((points[:, 1 - i] - lower[1 - i]) / cell_m for i in range(2))
    cell = np.ravel_multi_index((row.astype(int), column.astype(int)), shape, mode="clip")
    height = points[:, 2] - _ground_height(points, lower, upper)
    stands = (height > 0.4) & (height < 2.5)
    seen = np.bincount(cell, minlength=shape[0] * shape[1]).reshape(shape)
    standing = np.bincount(cell[stands], minlength=shape[0] * shape[1]).reshape(shape)
    return np.where(seen > 0, 0.955, 1.0) - 0.6 * (1.0 - np.exp(-standing / 2.5))


def _ground_height(points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Height of the ground under each point (N,): a low return in 2 m, its neighbours' median against outliers."""
    shape = np.ceil((upper - lower) / 2.0).astype(int)
    x, y = np.minimum(((points[:, :2] - lower) / 2.0).astype(int), shape - 1).T
    tile = x * shape[1] + y
    order = np.lexsort((points[:, 2], tile))
    count = np.bincount(tile, minlength=shape[0] * shape[1])
    filled = np.flatnonzero(count)
    low = (np.cumsum(count) - count + count // 20)[filled]  # what panes and puddles mirror lies below the ground
    ground = np.full(shape, np.inf, np.float32)
    ground.flat[filled] = points[order[low], 2]
    nearest_seen = distance_transform_edt(np.isinf(ground), return_distances=False, return_indices=True)
    return median_filter(ground[tuple(nearest_seen)], size=3, mode="nearest")[x, y]


def _grown(hull: np.ndarray, margin_m: float) -> np.ndarray:
    """Outline (M, 2) of a hull grown by a margin."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    disc = margin_m * np.column_stack([np.cos(angle), np.sin(angle)])
    return convex_hull((hull[:, None] + disc).reshape(-1, 2))


def _draw_scenes(axes: Axes, scenes: list[SceneRow]) -> None:
    """Outlines, each with its id where it is farthest from the middle of the others."""
    outlines = [_grown(scene.hull, scene.margin_m) for scene in scenes]
    middles = np.array([outline.mean(axis=0) for outline in outlines])
    for i, (scene, outline) in enumerate(zip(scenes, outlines, strict=True)):
        axes.add_patch(Polygon(outline, facecolor="#E69F0018", edgecolor="#b07d10", linewidth=0.8, linestyle="--"))
        others = np.delete(middles, i, axis=0).mean(axis=0) if len(scenes) > 1 else middles[0]
        x, y = outline[np.linalg.norm(outline - others, axis=1).argmax()]
        axes.text(x, y, f"scene {scene.scene_id}", color="#8a6000", fontsize=8, ha="center", path_effects=HALO)


def _draw_trajectory(axes: Axes, picture: MapPicture) -> None:
    """The path of each session, coloured by how often the robot had been there."""
    path, kind = picture.trajectory, np.clip(picture.visit_number, 1, 3) - 1
    xy = path.T_map_sensor[:, :2, 3]
    unbroken = path.session[1:] == path.session[:-1]
    for later, colour in enumerate(VISIT_COLOURS):
        chosen = unbroken & (kind[1:] == later)
        steps = np.stack([xy[:-1], xy[1:]], axis=1)[chosen]
        axes.add_collection(LineCollection(steps, color=colour, linewidth=1.4, capstyle="round"), autolim=False)
    for session in np.unique(path.session):
        start = xy[path.session == session][0]
        axes.plot(*start, marker="^", color="black", markersize=7, zorder=4)
        axes.annotate(f"start {session}", start, (6, -12), textcoords="offset points", fontsize=8, path_effects=HALO)


def _draw_changes(axes: Axes, changes: list[ChangeObject], size_m: np.ndarray) -> None:
    """Points, a ring to find them by, and the id of the largest."""
    labelled = {change.id for change in sorted(changes, key=lambda c: -c.n_points)[:MAX_LABELS]}
    for change in changes:
        colour, alpha = COLOURS[change.polarity], 1.0 if change.state == "present" else 0.4
        axes.scatter(*change.points[:, :2].T, s=1.5, color=colour, linewidths=0, alpha=alpha, zorder=5)
        ring = {"marker": MARKERS[change.polarity], "markersize": 15, "markerfacecolor": "none"}
        axes.plot(*change.centroid[:2], **ring, markeredgecolor=colour, markeredgewidth=1.6, alpha=alpha, zorder=5)
        if change.id in labelled:
            offset = 11 * _away(change, changes, 0.06 * size_m.max())
            axes.annotate(
                str(change.id), change.centroid[:2], offset, textcoords="offset points", ha="center", va="center",
                color=colour, fontsize=11, fontweight="bold", path_effects=HALO, zorder=6,
            )  # fmt: skip


def _away(change: ChangeObject, changes: list[ChangeObject], reach_m: float) -> np.ndarray:
    """Direction (2,) for a change's label that leads away from the changes around it."""
    others = np.array([other.centroid[:2] for other in changes if other.id != change.id]).reshape(-1, 2)
    push = change.centroid[:2] - others
    distance = np.linalg.norm(push, axis=1, keepdims=True)
    near = distance[:, 0] < reach_m
    total = (push[near] / np.maximum(distance[near], 0.1) ** 2).sum(axis=0) + [0.01, 0.01]
    return 1.5 * total / np.linalg.norm(total)


def _draw_scale(axes: Axes, lower: np.ndarray, upper: np.ndarray) -> None:
    width_m = upper[0] - lower[0]
    length_m = max(length for length in (1, 2, 5, 10, 20, 50, 100, 200, 500) if length < 0.25 * width_m)
    x, y = lower + 0.03 * width_m
    axes.plot([x, x + length_m], [y, y], color="black", linewidth=3, solid_capstyle="butt", path_effects=HALO)
    axes.annotate(f"{length_m} m", (x + length_m / 2, y), (0, 5), textcoords="offset points", ha="center",
                  fontsize=9, path_effects=HALO)  # fmt: skip


def _legend(picture: MapPicture) -> list[Line2D]:
    kinds = np.unique(np.clip(picture.visit_number, 1, 3)) - 1
    handles = [Line2D([], [], color=VISIT_COLOURS[i], linewidth=2, label=VISIT_NAMES[i]) for i in kinds]
    handles.append(Line2D([], [], color="#b07d10", linestyle="--", linewidth=0.8, label="scene"))
    handles.append(Line2D([], [], color="0.45", marker="s", linestyle="none", label="0.4-2.5 m above ground"))
    for polarity, colour in COLOURS.items():
        n = sum(change.polarity == polarity for change in picture.changes)
        handles.append(Line2D([], [], color=colour, marker=MARKERS[polarity], markerfacecolor="none", markersize=9,
                              markeredgewidth=1.6, linestyle="none", label=f"{polarity} ({n})"))  # fmt: skip
    if any(change.state == "ended" for change in picture.changes):
        handles.append(Line2D([], [], linestyle="none", label="pale: undone since"))
    return handles
