"""The stored scans that stand for a scene: those of its first visit, to which all later ones are registered."""

from __future__ import annotations

import numpy as np

from ..storage.errors import ScanFileError
from ..storage.rows import SceneScans
from ..storage.scans import ScanStore
from .sensors import Sensors
from .views import map_points

REFERENCE_SCANS = 10  # evenly spread: enough surface to register to


def reference_points(
    first_visit: SceneScans, scans: ScanStore, sensors: Sensors, range_m: float, n_scans: int = REFERENCE_SCANS
) -> np.ndarray:
    """Returns of some scans of a scene's first visit, (N, 3) float32 metres, map frame.

    Scans that the retention has just deleted, or that are damaged, are done without. Raises ScanFileError where none
    is left.
    """
    stored = list(zip(first_visit.session.tolist(), first_visit.scan_id.tolist(), strict=True))
    chosen = np.unique(np.linspace(0, len(stored) - 1, n_scans).round().astype(int)) if stored else []
    read = scans.read_all(stored[i] for i in chosen)
    if not read:
        raise ScanFileError("no scan of the scene's first visit can be read")
    # Ten scans fill the registration's voxels many times over: half of their columns are enough.
    return np.concatenate([map_points(scan, sensors.get(scan.sensor_digest), range_m, every=2) for scan in read])
