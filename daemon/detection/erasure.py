"""Brings older scans up to date: what is known to be gone is erased from them (CDSD III-D, update_map)."""

from __future__ import annotations

import numpy as np

from .arrays import bounds, inside
from .candidates import changed
from .results import ERASE_M, Erasure
from .submap import Submap


def update_map(submap: Submap, session: np.ndarray, erasures: list[Erasure]) -> Submap:
    """The submap without the points of removed objects; session (S,) of its scans.

    What an object left in scans taken before it was gone is erased; scans taken after it came back stay. Only what
    disappeared matters: what appeared is in the scans taken since.
    """
    stands = np.ones(len(submap.points), dtype=bool)
    for gone in erasures:
        lower, upper = bounds(gone.points)
        older = (session < gone.session) | ((session == gone.session) & (submap.stamp_ns < gone.gone_ns))
        near = np.flatnonzero(inside(submap.points, lower - np.float32(ERASE_M), upper + np.float32(ERASE_M)))
        near = near[older[submap.scan[near]]]
        stands[near] = changed(submap.points[near], gone.points, ERASE_M, 1)
    return submap if stands.all() else submap.only(stands)
