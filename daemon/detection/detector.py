"""Submap-to-submap change detection: the steps of CDSD section III-C, in order."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scipy.spatial import cKDTree

from ..stopwatch import Stopwatch
from .candidates import changed, dense_enough
from .clusters import cluster, thin
from .ground import Ground, is_ground_like, segment_ground
from .occlusion import latest_sight, persistent, scans_looking_through
from .results import DetectedObject, Detection, Thresholds
from .submap import Submap

GROW_M = 0.5  # an object is completed by candidates this near to its confirmed points that nothing speaks against
MIN_CONFIRMED_SHARE = 0.25  # of an object's points; a branch of which one leaf was looked past is no change


def detect(cumulative: Submap, recent: Submap, thresholds: Thresholds) -> Detection:
    """Changes of the recent submap against the cumulative one: what appeared and what disappeared."""
    t, watch = thresholds, Stopwatch()
    with ThreadPoolExecutor(2, thread_name_prefix="detect") as pool:  # the compiled loops run without the lock
        (standing_c, ground_c), (standing_r, ground_r) = pool.map(without_ground, (cumulative, recent), (t, t))
        watch.lap("ground")
        new, old = standing_r.points, standing_c.points
        is_new, is_old = pool.map(changed, (new, old), (old, new), (t.tau_m,) * 2, (t.n,) * 2)
        watch.lap("neighbours")
    appeared = _one_way("appeared", standing_r.only(is_new), standing_c, ground_c, t, watch)
    disappeared = _one_way("disappeared", standing_c.only(is_old), standing_r, ground_r, t, watch)
    return Detection(
        appeared.objects + disappeared.objects,
        appeared.n_candidates + disappeared.n_candidates,
        appeared.n_confirmed + disappeared.n_confirmed,
        watch.seconds,
    )


def without_ground(submap: Submap, t: Thresholds) -> tuple[Submap, Ground]:
    """A submap's points that are not ground, and the ground."""
    centre = np.mean([-image.T_sensor_map[:3, :3].T @ image.T_sensor_map[:3, 3] for image in submap.images], axis=0)
    is_ground, ground = segment_ground(submap.points, centre[:2], t.ground_sigmas, t.ground_min_sigma_m)
    return submap.only(~is_ground), ground


def _one_way(
    polarity: str, this: Submap, other: Submap, other_ground: Ground, t: Thresholds, watch: Stopwatch
) -> Detection:
    """Objects among the candidate points of this submap that the other one could have seen and did not."""
    this = this.only(dense_enough(this.points, t.rho_m, t.n))
    watch.lap("noise")
    points, scan = this.points, this.scan
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
    return Detection(objects, len(points), int(confirmed.sum()), watch.seconds)


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
