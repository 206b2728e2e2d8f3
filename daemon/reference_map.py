"""A scene's first visit as a map to which later ones are registered, built scan by scan."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .plane_map import PlaneMap
from .registration import Surface, surface_of
from .sweep_fit import Planes
from .voxels import Moments

COARSE_VOXEL_M = 0.6  # of what a scan far off its place is registered to


class ReferenceMap:
    """scans: the cells of one scan of the first visit after another, in the map; each takes tens of milliseconds."""

    def __init__(self, scans: Iterator[Moments], voxel_m: float):
        self._scans = scans
        self._planes = PlaneMap(voxel_m)
        self._surface: Surface | None = None
        self._complete = False

    def build_on(self) -> bool:
        """Take one more scan; False once there was none left."""
        cells = None if self._complete else next(self._scans, None)
        if cells is None:
            self._complete = True
            return False
        self._planes.add(cells)
        return True

    def complete(self) -> bool:
        """Take all the scans that are left; whether there is anything to register to."""
        while self.build_on():
            pass
        return len(self._planes) > 0

    def planes_at(self, points: np.ndarray) -> Planes:
        """The planes of the voxels that points (N, 3), map frame, lie in."""
        return self._planes.planes_at(points)

    def surface(self) -> Surface:
        """The coarse surface, of a complete map."""
        if self._surface is None:
            self._surface = surface_of(self._planes.means, COARSE_VOXEL_M)
        return self._surface
