"""Occlusion filter: could the other visit have seen this place, and did it see past it? (CDSD III-C, Fig. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .results import KnownChange, KnownState
from .submap import DepthImage, Submap


@dataclass(frozen=True, eq=False)
class Sight:
    """What scans saw at the place of each point: looks through it and looks that ended at it, both (N,) int16.

    A point in neither is not observed: occluded, out of view, too far, or without a return behind it.
    """

    through: np.ndarray
    at: np.ndarray


def sight(points: np.ndarray, images: list[DepthImage], margin_m: float, range_m: float) -> Sight:
    """Look at points (N, 3) with each scan; a return `margin` behind a point means the beam went through its place."""
    through = np.zeros(len(points), dtype=np.int16)
    at = np.zeros(len(points), dtype=np.int16)
    for image in images:
        distance, seen = image.look_at(points)
        near = distance < range_m
        with np.errstate(invalid="ignore"):  # NaN compares false: unknown counts for neither
            through += near & (seen > distance + margin_m)
            at += near & (np.abs(seen - distance) <= margin_m)
    return Sight(through, at)


def latest_sight(points: np.ndarray, other: Submap, margin_m: float, range_m: float, min_scans: int) -> Sight:
    """Sight of points by the latest visit of the other submap that could see their place in min_scans scans.

    A cumulative submap holds visits from before and after an older change; what an early visit saw says nothing
    once a later one has looked.
    """
    result = Sight(np.zeros(len(points), dtype=np.int16), np.zeros(len(points), dtype=np.int16))
    open_ = np.arange(len(points))
    for visit in np.unique(other.visit)[::-1]:
        images = [image for image, v in zip(other.images, other.visit, strict=True) if v == visit]
        seen = sight(points[open_], images, margin_m, range_m)
        result.through[open_], result.at[open_] = seen.through, seen.at
        open_ = open_[seen.through + seen.at < min_scans]
    return result


def persistent(
    points: np.ndarray, scan: np.ndarray, own: Submap, margin_m: float, range_m: float, min_scans: int, min_s: float
) -> np.ndarray:
    """Which points (N, 3), each of scan (N,) of its own submap, stayed where they were through their own visit.

    A thing that is there to stay is met by several scans of the visit that saw it, over some seconds, and hardly
    ever looked through by them; a walking person is gone in the next scan, a slow car a second later, and leaves in
    the wind let beams through. That nothing looks through is not enough: before the sky there is no return behind a
    walker's head. Scans of other visits must not be asked: they did look through what appeared later.
    """
    out = np.zeros(len(points), dtype=bool)
    visit = own.visit[scan]
    for v in np.unique(visit):
        of_visit = np.flatnonzero(visit == v)
        through, at = np.zeros((2, len(of_visit)), dtype=np.int16)
        first, last = np.full(len(of_visit), np.iinfo(np.int64).max), np.zeros(len(of_visit), dtype=np.int64)
        for i in np.flatnonzero(own.visit == v):
            seen = sight(points[of_visit], [own.images[i]], margin_m, range_m)
            through += seen.through
            at += seen.at
            met = seen.at > 0
            first[met] = np.minimum(first[met], own.stamp_ns[i])
            last[met] = np.maximum(last[met], own.stamp_ns[i])
        out[of_visit] = (at >= min_scans) & (through * 2 < at) & (last - first >= min_s * 1e9)
    return out


def scans_looking_through(points: np.ndarray, images: list[DepthImage], margin_m: float, range_m: float) -> np.ndarray:
    """Indices of the scans that looked through at least a tenth of an object's points (N, 3)."""
    share = [sight(points, [image], margin_m, range_m).through.mean() for image in images]
    return np.flatnonzero(np.array(share) >= 0.1)


def state_of(change: KnownChange, images: list[DepthImage], margin_m: float, range_m: float) -> KnownState:
    """What the scans of a visit saw at the place of a known change: the thing, past its place, or neither."""
    seen = sight(change.points, images, margin_m, range_m)
    there, empty = seen.at > seen.through, seen.through > seen.at
    still, undone = (there, empty) if change.polarity == "appeared" else (empty, there)
    return KnownState(change.change_id, float(still.mean()), float(undone.mean()))
