"""Submap-to-submap change detection: the steps of CDSD section III-C, in order."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from .candidates import changed, dense_enough
from .clusters import cluster, thin
from .ground import Ground, is_ground_like, segment_ground
from .occlusion import latest_sight, persistent, scans_looking_through
from .submap import Submap

GROW_M = 0.5  # an object is completed by candidates this near to its confirmed points that nothing speaks against
MIN_CONFIRMED_SHARE = 0.25  # of an object's points; a branch of which one leaf was looked past is no change


@dataclass(frozen=True)
class Thresholds:
    """The detector's parameters; names, units and sources as in the settings' section [detection]."""

    tau_m: float
    n: int
    rho_m: float
    ground_sigmas: float
    ground_min_sigma_m: float
    occlusion_range_m: float
    occlusion_margin_m: float
    min_confirming_scans: int
    min_showing_scans: int
    min_showing_s: float
    cluster_distance_m: float
    min_points: int
    ground_filter_c1_m: float
    ground_filter_c2: float


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """One change: its points (N, 3) float32 map frame, one for each 5 cm voxel, and the evidence for it."""

    polarity: str  # "appeared" or "disappeared"
    points: np.ndarray
    before_ns: int  # last scan that showed the old state
    after_ns: int  # first scan that showed the new one
    n_confirmed: int  # points whose place the other visit looked through
    n_seen_by: int  # scans of its own submap that saw it
    n_confirming: int  # scans of the other submap that looked through its place


@dataclass(frozen=True, eq=False)
class Detection:
    """Result of one instance: the objects, points left after each step, and seconds for each step."""

    objects: list[DetectedObject]
    n_candidates: int
    n_confirmed: int
    seconds: dict[str, float]


def detect(cumulative: Submap, recent: Submap, thresholds: Thresholds) -> Detection:
    """Changes of the recent submap against the cumulative one: what appeared and what disappeared."""
    watch = Stopwatch()
    standing_c, ground_c = _without_ground(cumulative, thresholds)
    standing_r, ground_r = _without_ground(recent, thresholds)
    watch.lap("ground")
    appeared = _one_way("appeared", standing_r, standing_c, ground_c, thresholds, watch)
    disappeared = _one_way("disappeared", standing_c, standing_r, ground_r, thresholds, watch)
    return Detection(
        appeared.objects + disappeared.objects,
        appeared.n_candidates + disappeared.n_candidates,
        appeared.n_confirmed + disappeared.n_confirmed,
        watch.seconds,
    )


class Stopwatch:
    """Seconds spent since the last lap, summed by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Book the time since the last lap under a name."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


def _without_ground(submap: Submap, t: Thresholds) -> tuple[Submap, Ground]:
    centre = np.mean([-image.T_sensor_map[:3, :3].T @ image.T_sensor_map[:3, 3] for image in submap.images], axis=0)
    is_ground, ground = segment_ground(submap.points, centre[:2], t.ground_sigmas, t.ground_min_sigma_m)
    return submap.only(~is_ground), ground


def _one_way(
    polarity: str, this: Submap, other: Submap, other_ground: Ground, t: Thresholds, watch: Stopwatch
) -> Detection:
    """Objects that stand in this submap and not in the other."""
    candidate = np.flatnonzero(changed(this.points, other.points, t.tau_m, t.n))
    watch.lap("neighbours")
    candidate = candidate[dense_enough(this.points[candidate], t.rho_m, t.n)]
    watch.lap("noise")
    points, scan = this.points[candidate], this.scan[candidate]
    sight_limits = (t.occlusion_margin_m, t.occlusion_range_m)
    seen = latest_sight(points, other, *sight_limits, t.min_confirming_scans)
    confirmed = (seen.through >= t.min_confirming_scans) & (seen.through > seen.at)
    possible = confirmed | (seen.at <= seen.through)
    possible[possible] = persistent(
        points[possible], scan[possible], this, *sight_limits, t.min_showing_scans, t.min_showing_s
    )
    confirmed &= possible
    watch.lap("occlusion")
    objects = []
    for member in _objects(points, confirmed, possible, t.cluster_distance_m):
        kept = member[thin(points[member])]
        own_scans = np.unique(scan[member])
        sure = kept[confirmed[kept]]
        if len(sure) < max(t.min_points, MIN_CONFIRMED_SHARE * len(kept)) or len(own_scans) < t.min_showing_scans:
            continue
        if is_ground_like(points[kept], other_ground, t.ground_filter_c1_m, t.ground_filter_c2):
            continue
        through = scans_looking_through(points[sure], other.images, *sight_limits)
        if len(through) < t.min_confirming_scans:
            continue
        own_ns, other_ns = this.stamp_ns[own_scans], other.stamp_ns[through]
        before, after = (other_ns, own_ns) if polarity == "appeared" else (own_ns, other_ns)
        objects.append(
            DetectedObject(
                polarity, points[kept], int(before.max()), int(after.min()), len(sure), len(own_scans), len(through)
            )
        )
    watch.lap("clusters")
    return Detection(objects, len(candidate), int(confirmed.sum()), watch.seconds)


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
