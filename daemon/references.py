"""The stored scans that stand for a scene: those of its first visit, to which all later ones are registered."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..storage.errors import ScanFileError
from ..storage.rows import SceneScans
from ..storage.scans import ScanStore
from .config import AlignmentConfig
from .sensors import Sensors
from .sweep import sweep_of
from .views import map_points
from .voxels import Moments

REFERENCE_SCANS = 10  # evenly spread: enough surface to register to


def reference_points(
    first_visit: SceneScans, scans: ScanStore, sensors: Sensors, range_m: float, n_scans: int = REFERENCE_SCANS
) -> np.ndarray:
    """Returns of some scans of a scene's first visit, (N, 3) float32 metres, map frame.

    Scans that the retention has just deleted, or that are damaged, are done without. Raises ScanFileError where none
    is left.
    """
    read = scans.read_all(_spread(first_visit, n_scans))
    if not read:
        raise ScanFileError("no scan of the scene's first visit can be read")
    # Ten scans fill the registration's voxels many times over: half of their columns are enough.
    return np.concatenate([map_points(scan, sensors.get(scan.sensor_digest), range_m, every=2) for scan in read])


def reference_cells(
    first_visit: SceneScans, scans: ScanStore, sensors: Sensors, config: AlignmentConfig
) -> Iterator[Moments]:
    """The cells, in the map, of some scans of a scene's first visit, one after another; of those that can be read."""
    for chosen in _spread(first_visit, REFERENCE_SCANS):
        for scan in scans.read_all([chosen]):
            sweep = sweep_of(scan, sensors.get(scan.sensor_digest), config.range_m, config.cell_m)
            yield sweep.in_map(scan.T_map_sensor, scan.T_start_end)


def _spread(visit: SceneScans, count: int) -> list[tuple[int, int]]:
    """Session and id of so many scans of a visit, evenly spread; fewer where it has fewer."""
    n = len(visit.scan_id)
    chosen = np.unique(np.linspace(0, n - 1, min(count, n)).round().astype(int))
    return list(zip(visit.session[chosen].tolist(), visit.scan_id[chosen].tolist(), strict=True))
