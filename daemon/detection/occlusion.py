"""Occlusion filter: could the other visit have seen this place, and did it see past it? (CDSD III-C, Fig. 4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .results import KnownChange, KnownState
from .submap import AT, GLIMPSED, OPEN, THROUGH, DepthImage, Submap

ARRIVAL_RATIO = 1.4  # of the time asked of a thing that was there all along: since it came
LEFT_SCANS = 1  # that look through a place after it was met last: what was there has left
NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, eq=False)
class Sight:
    """How many scans looked through the place of each point, met it there, or had no return at all: (N,) int16 each.

    A point without any is not observed: occluded, out of view or too far.
    """

    through: np.ndarray
    at: np.ndarray
    open: np.ndarray


def sight(points: np.ndarray, images: list[DepthImage], margin_m: float, range_m: float) -> Sight:
    """Look at points (N, 3) with each scan."""
    through, at, open_ = np.zeros((3, len(points)), dtype=np.int16)
    for image in images:
        seen = image.look_at(points, margin_m, range_m)
        through += seen == THROUGH
        at += seen == AT
        open_ += seen == OPEN
    return Sight(through, at, open_)


def latest_sight(points: np.ndarray, other: Submap, margin_m: float, range_m: float, min_scans: int) -> Sight:
    """Sight of points by the latest visit of the other submap that could see their place in min_scans scans.

    A cumulative submap holds visits from before and after an older change; what an early visit saw says nothing
    once a later one has looked. Counts of scans without a return are of the visits asked, together.
    """
    result = Sight(*np.zeros((3, len(points)), dtype=np.int16))
    unsettled = np.arange(len(points))
    for visit in np.unique(other.visit)[::-1]:
        images = [image for image, v in zip(other.images, other.visit, strict=True) if v == visit]
        seen = sight(points[unsettled], images, margin_m, range_m)
        result.through[unsettled], result.at[unsettled] = seen.through, seen.at
        result.open[unsettled] += seen.open
        unsettled = unsettled[seen.through + seen.at < min_scans]
    return result


def persistent(
    points: np.ndarray,
    scan: np.ndarray,
    own: Submap,
    margin_m: float,
    range_m: float,
    min_scans: int,
    min_s: float,
    glimpses: bool,
    arrivals: bool,
) -> np.ndarray:
    """Which points (N, 3), each of scan (N,) of its own submap, stayed where they were through their own visit.

    A thing that is there to stay is met by several scans of the visit that saw it, over some seconds, and hardly
    ever looked through by them; a walking person is gone in the next scan, a slow car a second later, and leaves in
    the wind let beams through. That nothing looks through is not enough: before the sky there is no return behind a
    walker's head. Scans of other visits must not be asked: they did look through what appeared later. glimpses count
    as meetings for a thing that is sure already: its edges are seldom met by nine pixels. arrivals: what came in the
    middle of the visit, and was met for long enough since nothing looked through it any more, has stayed too.
    """
    out = np.zeros(len(points), dtype=bool)
    visit = own.visit[scan]
    for v in np.unique(visit):
        of_visit = np.flatnonzero(visit == v)
        through, at = np.zeros((2, len(of_visit)), dtype=np.int16)
        at_since, through_since = np.zeros((2, len(of_visit)), dtype=np.int16)  # looked through last, met last
        first, last = np.full(len(of_visit), NEVER), np.zeros(len(of_visit), dtype=np.int64)
        first_since = np.full(len(of_visit), NEVER)
        scans = np.flatnonzero(own.visit == v)
        for i in scans[np.argsort(own.stamp_ns[scans], kind="stable")]:
            seen = own.images[i].look_at(points[of_visit], margin_m, range_m)
            passed, met = seen == THROUGH, (seen == AT) | (glimpses & (seen == GLIMPSED))
            through += passed
            at += met
            at_since += met
            at_since[passed], first_since[passed] = 0, NEVER
            through_since[met] = 0
            through_since += passed
            first[met] = np.minimum(first[met], own.stamp_ns[i])
            first_since[met] = np.minimum(first_since[met], own.stamp_ns[i])
            last[met] = own.stamp_ns[i]
        stayed = (at >= min_scans) & (through * 2 < at) & (last - first >= min_s * 1e9) & (through_since < LEFT_SCANS)
        if arrivals:
            stayed |= (at_since >= min_scans) & (last - first_since >= ARRIVAL_RATIO * min_s * 1e9)
        out[of_visit] = stayed
    return out


def scans_looking_through(points: np.ndarray, images: list[DepthImage], margin_m: float, range_m: float) -> np.ndarray:
    """Indices of the scans that looked through at least a tenth of an object's points (N, 3)."""
    share = [(image.look_at(points, margin_m, range_m) == THROUGH).mean() for image in images]
    return np.flatnonzero(np.array(share) >= 0.1)


def state_of(change: KnownChange, images: list[DepthImage], margin_m: float, range_m: float) -> KnownState:
    """What the scans of a visit saw at the place of a known change: the thing, past its place, or neither."""
    seen = sight(change.points, images, margin_m, range_m)
    there, empty = seen.at > seen.through, seen.through > seen.at
    still, undone = (there, empty) if change.polarity == "appeared" else (empty, there)
    return KnownState(change.change_id, float(still.mean()), float(undone.mean()))
