"""What is known of the points of one side: did they stay through their visit, what did the other side see there?"""

from __future__ import annotations

import numpy as np

from .candidates import changed
from .occlusion import latest_sight, persistent
from .results import Thresholds
from .submap import Submap

COMPLETE_M = 1.5  # so far around its confirmed points an object may be completed


class Evidence:
    """What is known of the points of a submap by the scans of the other side and of their own."""

    def __init__(self, this: Submap, other: Submap, t: Thresholds, glimpses: bool = False):
        """glimpses: for points beside what is sure already, half the margin behind them and glimpses are enough."""
        self._this, self._t, self._glimpses = this, t, glimpses
        self._limits = (0.5 if glimpses else 1.0) * t.occlusion_margin_m, t.occlusion_range_m
        self._arrivals = this.visit.min() > other.visit.max()  # what left in an older visit was only passing by
        self._seen = latest_sight(this.points, other, *self._limits, t.min_confirming_scans)

    def confirmed(self) -> np.ndarray:
        """Which points stayed through their own visit, and were looked through by the other: (N,) bool."""
        return self._stayed(self._looked_through())

    def possible(self, confirmed: np.ndarray) -> np.ndarray:
        """Which points may belong to an object as well, (N,) bool: around confirmed ones, and nothing against them."""
        possible = (self._seen.at <= self._seen.through) & ~self._looked_through()
        points = self._this.points
        possible[possible] = ~changed(points[possible], points[confirmed], COMPLETE_M, 1)
        return self._stayed(possible) | confirmed

    def in_vain(self) -> np.ndarray:
        """To which points the other visit looked, (N,) bool: no return from there, nor from anything before it."""
        seen = self._seen
        return (seen.at == 0) & (seen.through + seen.open >= self._t.min_confirming_scans)

    def stayed(self, asked: np.ndarray, scans: Submap) -> np.ndarray:
        """Which of some points, asked (M,) indices or (N,) bool, stayed through their visit by these scans: (M,) bool.

        The submap's own first, by which the points know theirs. Few of them see a place: it may be by chance that they
        met somebody there each time, and only the others saw it empty in between.
        """
        this, t = self._this, self._t
        stay = t.min_showing_scans, t.min_showing_s, self._glimpses, self._arrivals
        return persistent(this.points[asked], this.scan[asked], scans, *self._limits, *stay)

    def _looked_through(self) -> np.ndarray:
        return (self._seen.through >= self._t.min_confirming_scans) & (self._seen.through > self._seen.at)

    def _stayed(self, asked: np.ndarray) -> np.ndarray:
        asked[asked] = self.stayed(asked, self._this)
        return asked
