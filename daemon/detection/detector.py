"""Submap-to-submap change detection: the steps of CDSD section III-C, in order."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from ..stopwatch import Stopwatch
from .arrays import bounds, inside
from .candidates import changed, dense_enough
from .clusters import cluster, thin
from .evidence import COMPLETE_M, Evidence
from .ground import Ground, is_ground_like, segment_ground
from .occlusion import scans_looking_through
from .results import DetectedObject, Detection, Thresholds
from .submap import NO_SCANS, Submap, join

GROW_M = 0.5  # an object is completed by candidates this near to its confirmed points that nothing speaks against
COMPLETE_STEP_M = 0.2  # ... and by looked-through points of any distance, without a gap wider than this
COUNTERPART_POINTS = 50  # what left beside a thing that came is no candidate by itself: ask for more of it,
COUNTERPART_SHARE = 0.1  # also against the size of what came
APART_M = 0.12  # of what the other visit met: nearer, a level surface is looked over by poses 10 cm too high
INSIDE_SHARE = 0.7  # of an object's points within another's outline, seen from above: it is a part of that
LOW_M, LOW_SHARE = 0.4, 0.9  # above the ground, and of its points: an object that is low
FAR_M = 2.0  # a distance to the other submap beyond this is not measured
MIN_CONFIRMED_SHARE = 0.25  # of an object's points; a branch of which one leaf was looked past is no change
STAYED_SHARE = 0.5  # of an object's confirmed points, which must have stayed by all scans near it


Around = Callable[[np.ndarray, np.ndarray], Submap]  # lower and upper corner (3,) of a box, map frame -> what is in it


@dataclass(frozen=True, eq=False)
class Side:
    """One side of the comparison: its submap without ground, the ground, and what more scans of it saw in a box."""

    standing: Submap
    ground: Ground
    more: Around


def side_of(submap: Submap, thresholds: Thresholds, more: Around | None = None) -> Side:
    """A submap as the detector wants it. more: its side's other scans, ground too, by which objects are completed."""
    t = thresholds
    centre = np.mean([-image.T_sensor_map[:3, :3].T @ image.T_sensor_map[:3, 3] for image in submap.images], axis=0)
    is_ground, ground = segment_ground(submap.points, centre[:2], t.ground_sigmas, t.ground_min_sigma_m)
    return Side(submap.only(~is_ground), ground, more or (lambda lower, upper: NO_SCANS))


def detect(before: Side, now: Side, thresholds: Thresholds) -> Detection:
    """Changes of the later side against the earlier: what appeared and what disappeared."""
    t, watch = thresholds, Stopwatch()
    new, old = now.standing.points, before.standing.points
    with ThreadPoolExecutor(2, thread_name_prefix="detect") as pool:  # the compiled loops run without the lock
        is_new, is_old = pool.map(changed, (new, old), (old, new), (t.tau_m,) * 2, (t.n,) * 2)
    watch.lap("neighbours")
    appeared = _one_way("appeared", now, is_new, before, t, watch)
    disappeared = _one_way("disappeared", before, is_old, now, t, watch)
    left = _counterparts(appeared.objects, disappeared.objects, "disappeared", before, now, t)
    taken = _counterparts(disappeared.objects, appeared.objects, "appeared", now, before, t)
    watch.lap("clusters")
    return Detection(
        appeared.objects + disappeared.objects + left + taken,
        appeared.n_candidates + disappeared.n_candidates,
        appeared.n_confirmed + disappeared.n_confirmed,
        watch.seconds,
    )


def _one_way(polarity: str, side: Side, is_far: np.ndarray, other: Side, t: Thresholds, watch: Stopwatch) -> Detection:
    """Objects among the points of one side that are far from the other's, which could have seen them and did not."""
    this = side.standing.only(is_far)
    this = this.only(dense_enough(this.points, t.rho_m, t.n))
    watch.lap("noise")
    evidence = Evidence(this, other.standing, t)
    confirmed = evidence.confirmed()
    possible = evidence.possible(confirmed)
    in_vain = this.points[possible & evidence.in_vain()]
    watch.lap("occlusion")
    objects = []
    for member in _objects(this.points, confirmed, possible, t.cluster_distance_m):
        kept = member[thin(this.points[member])]
        sure = kept[confirmed[kept]]
        if len(sure) < max(t.min_points, MIN_CONFIRMED_SHARE * len(kept)):
            continue
        if len(np.unique(this.scan[member])) < t.min_showing_scans:
            continue
        if is_ground_like(this.points[kept], other.ground, t.ground_filter_c1_m, t.ground_filter_c2):
            continue
        if evidence.stayed(sure, join(this, side.more(*bounds(this.points[sure])))).mean() < STAYED_SHARE:
            continue
        more = _completion(this.points[sure], in_vain, side, other, t)
        found = _described(polarity, this, member, sure, more, other.standing, t)
        if found is not None and not _is_grass(found, other.ground):
            objects.append(found)
    objects = _joined(objects)
    watch.lap("clusters")
    return Detection(objects, len(this.points), int(confirmed.sum()), watch.seconds)


def _is_grass(found: DetectedObject, ground: Ground) -> bool:
    """Whether an object is low everywhere and owes most of its points to its completion: rough ground, grass."""
    low = ground.is_under(found.points, 1.0, LOW_M).mean() >= LOW_SHARE
    return bool(low and found.n_confirmed < MIN_CONFIRMED_SHARE * len(found.points))


def _joined(objects: list[DetectedObject]) -> list[DetectedObject]:
    """Objects that are parts of a larger one made one with it: completed until they touch, or inside its outline.

    What is seen through a car's windows lies a metre behind its skin; the leaves of a fallen tree part in clusters.
    """
    wholes: list[DetectedObject] = []
    for part in sorted(objects, key=lambda found: -len(found.points)):
        index = next((i for i, whole in enumerate(wholes) if _is_part(part, whole)), None)
        if index is None:
            wholes.append(part)
        else:
            wholes[index] = _both(wholes[index], part)
    return wholes


def _is_part(part: DetectedObject, whole: DetectedObject) -> bool:
    if not changed(part.points, whole.points, COMPLETE_STEP_M, 1).all():
        return True
    try:
        outline = Delaunay(whole.points[:, :2])
    except QhullError:  # as thin as a line
        return False
    return bool((outline.find_simplex(part.points[:, :2]) >= 0).mean() >= INSIDE_SHARE)


def _both(whole: DetectedObject, part: DetectedObject) -> DetectedObject:
    points = np.concatenate([whole.points, part.points])
    return replace(
        whole,
        points=points[thin(points)],
        before_ns=max(whole.before_ns, part.before_ns),
        after_ns=min(whole.after_ns, part.after_ns),
        n_confirmed=whole.n_confirmed + part.n_confirmed,
        n_seen_by=max(whole.n_seen_by, part.n_seen_by),
        n_confirming=max(whole.n_confirming, part.n_confirming),
    )


def _completion(sure: np.ndarray, in_vain: np.ndarray, side: Side, other: Side, t: Thresholds) -> np.ndarray:
    """Points (M, 3) around an object's confirmed ones that its own distance, or the sky behind it, did not confirm.

    A door that closes a car, a bag against a wall: most of it lies within tau of what stays. Its own distance says
    nothing, but the beams that went through its place do; beside an object that is sure they are believed. So are
    candidates before the sky, a sign on its pole: no beam came back from there.
    """
    near = _looked_through_around(sure, side, other, t, glimpses=True).points
    lower, upper = bounds(sure)
    reach = np.float32(COMPLETE_M)
    more = np.concatenate([near, in_vain[inside(in_vain, lower - reach, upper + reach)]])
    if not len(more):
        return more
    more = more[thin(more)]
    label = cluster(np.concatenate([sure, more]), COMPLETE_STEP_M)
    return more[np.isin(label[len(sure) :], label[: len(sure)])]


def _counterparts(
    found: list[DetectedObject],
    known: list[DetectedObject],
    polarity: str,
    side: Side,
    other: Side,
    t: Thresholds,
) -> list[DetectedObject]:
    """What left the place beside a thing that came, or came where one left, and is within tau of what stays there.

    A door that opens is gone from its frame, but nearly all of the frame is still within tau of it: no candidates to
    begin with. Where a change is sure, the beams that went through its counterpart's place are believed alone.
    """
    counterparts = []
    for change in found:
        near = _looked_through_around(change.points, side, other, t, glimpses=False)
        for old in known + counterparts:
            near = near.only(changed(near.points, old.points, t.tau_m, 1))
        if not len(near.points):
            continue
        label = cluster(near.points, COMPLETE_STEP_M)
        least = max(COUNTERPART_POINTS, COUNTERPART_SHARE * len(change.points))
        for i in np.flatnonzero(np.bincount(label) >= least):
            member = np.flatnonzero(label == i)
            if is_ground_like(near.points[member], other.ground, t.ground_filter_c1_m, t.ground_filter_c2):
                continue
            more = _completion(near.points[member], near.points[:0], side, other, t)
            described = _described(polarity, near, member, member, more, other.standing, t)
            counterparts += [described] if described else []
    return counterparts


def _looked_through_around(points: np.ndarray, side: Side, other: Side, t: Thresholds, glimpses: bool) -> Submap:
    """What stands around some points, by all scans of a side, and was looked through by the other; one per voxel.

    What the other side met in the same place is left out: a roof at the sensor's height is both looked over and met.
    """
    lower, upper = bounds(points)
    box = lower - np.float32(COMPLETE_M), upper + np.float32(COMPLETE_M)
    near = join(side.standing.around(*box), side.more(*box))
    near = near.only(_first_of_voxels(near.points))
    for ground in (side.ground, other.ground):
        near = near.only(~ground.is_under(near.points, t.ground_sigmas, t.ground_min_sigma_m))
    near = near.only(changed(near.points, other.standing.points, APART_M, 1))
    return near.only(Evidence(near, other.standing, t, glimpses).confirmed())


def _described(
    polarity: str, this: Submap, member: np.ndarray, sure: np.ndarray, more: np.ndarray, other: Submap, t: Thresholds
) -> DetectedObject | None:
    """An object with its evidence; None where no two scans of the other submap look through enough of it."""
    through = scans_looking_through(this.points[sure], other.images, t.occlusion_margin_m, t.occlusion_range_m)
    if len(through) < t.min_confirming_scans:
        return None
    own_scans = np.unique(this.scan[member])
    own_ns, other_ns = this.stamp_ns[own_scans], other.stamp_ns[through]
    before, after = (other_ns, own_ns) if polarity == "appeared" else (own_ns, other_ns)
    points = np.concatenate([this.points[sure], this.points[member], more])
    points = points[thin(points)]
    beyond_m = _distance_m(this.points[sure], other) - t.tau_m
    return DetectedObject(
        polarity, points, int(before.max()), int(after.min()), len(sure), len(own_scans), len(through), beyond_m
    )


def _distance_m(points: np.ndarray, other: Submap) -> float:
    """Median distance of some points to the other submap, at most FAR_M."""
    lower, upper = bounds(points)
    near = other.around(lower - np.float32(FAR_M), upper + np.float32(FAR_M)).points
    if not len(near):
        return FAR_M
    return float(np.median(np.minimum(cKDTree(near).query(points, distance_upper_bound=FAR_M)[0], FAR_M)))


def _first_of_voxels(points: np.ndarray) -> np.ndarray:
    first = np.zeros(len(points), dtype=bool)
    first[thin(points)] = True
    return first


def _objects(points: np.ndarray, confirmed: np.ndarray, possible: np.ndarray, distance_m: float) -> list[np.ndarray]:
    """Indices of each object's points: components of the confirmed points, completed by possible ones nearby."""
    seeds = np.flatnonzero(confirmed)
    if len(seeds) == 0:
        return []
    seeds_thin = seeds[thin(points[seeds])]
    label_thin = cluster(points[seeds_thin], distance_m)
    around = np.flatnonzero(possible)
    distance, nearest = cKDTree(points[seeds_thin]).query(points[around], distance_upper_bound=GROW_M)
    reached = np.isfinite(distance)
    label, member = label_thin[nearest[reached]], around[reached]
    order = np.argsort(label, kind="stable")
    return np.split(member[order], np.cumsum(np.bincount(label))[:-1])
