"""Brings older scans up to date: what is known to be gone is erased from them (CDSD III-D, update_map)."""

from __future__ import annotations

import numpy as np

from .arrays import bounds, inside
from .candidates import changed
from .results import ERASE_M, Erasure
from .submap import Submap


def update_map(submap: Submap, session: np.ndarray, erasures: list[Erasure]) -> Submap:
    """The submap without the points of removed objects; session (S,) of its scans."""
    stands = standing(submap.points, submap.scan, np.column_stack([session, submap.stamp_ns]), erasures)
    return submap if stands.all() else submap.only(stands)


def standing(points: np.ndarray, scan: np.ndarray, taken: np.ndarray, erasures: list[Erasure]) -> np.ndarray:
    """Which points (N, 3) float32 are not of a removed object.

    scan (N,) is the index of each point's scan; taken (S, 2) int64: a scan's session and sensor time. What an object
    left in scans taken before it was gone is erased; scans taken after it came back stay. Only what disappeared
    matters: what appeared is in the scans taken since.
    """
    stands = np.ones(len(points), dtype=bool)
    for gone in erasures:
        lower, upper = bounds(gone.points)
        older = (taken[:, 0] < gone.session) | ((taken[:, 0] == gone.session) & (taken[:, 1] < gone.gone_ns))
        near = np.flatnonzero(inside(points, lower - np.float32(ERASE_M), upper + np.float32(ERASE_M)))
        near = near[older[scan[near]]]
        stands[near] = changed(points[near], gone.points, ERASE_M, 1)
    return stands
