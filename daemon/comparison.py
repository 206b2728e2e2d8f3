"""The heavy half of an instance: load two sets of scans, bring them up to date, and compare them.

It runs in a process of its own (detection_process.py): KISS-ICP and GICP hold the interpreter's lock for tens of
milliseconds, and beside them every numpy call here would wait for it (five times the time, measured).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..storage.datadir import DataDir
from ..storage.scans import Scan, ScanStore
from .changes import Erasure, standing
from .detection.detector import Detection, Stopwatch, Thresholds, detect
from .detection.submap import Submap
from .sensors import Sensors
from .views import build_submap


@dataclass(frozen=True, eq=False)
class Selection:
    """Scans of one submap: session (S,), scan_id (S,) and visit (S,), int64."""

    session: np.ndarray
    scan_id: np.ndarray
    visit: np.ndarray


@dataclass(frozen=True, eq=False)
class Job:
    """What to compare."""

    cumulative: Selection
    recent: Selection
    erasures: list[Erasure]  # removed objects, known before the visit
    range_m: float
    thresholds: Thresholds


@dataclass(frozen=True, eq=False)
class ScanFacts:
    """What the record of a change needs of each scan of a submap, by its sensor time."""

    session: dict[int, int]
    host_ns: dict[int, int]
    residual_m: float  # mean over the scans


@dataclass(frozen=True, eq=False)
class Comparison:
    """What came of it."""

    detection: Detection
    cumulative: ScanFacts
    recent: ScanFacts
    seconds: dict[str, float]


class Comparer:
    """Compares scans of one data directory; keeps the sensors' geometries between jobs."""

    def __init__(self, data: Path):
        directory = DataDir.open_reader(data)
        self._scans = ScanStore(directory.scans_path)
        self._sensors = Sensors(directory)

    def compare(self, job: Job) -> Comparison:
        """Raises ScanFileError where a scan's file is damaged or gone."""
        watch = Stopwatch()
        cumulative, facts_c = self._load(job.cumulative, job)
        recent, facts_r = self._load(job.recent, job)
        watch.lap("load")
        taken = np.column_stack([job.cumulative.session, cumulative.stamp_ns])[cumulative.scan]
        cumulative = cumulative.only(standing(cumulative.points, taken, job.erasures))
        watch.lap("update_map")
        detection = detect(cumulative, recent, job.thresholds)
        return Comparison(detection, facts_c, facts_r, {**watch.seconds, **detection.seconds})

    def _load(self, selection: Selection, job: Job) -> tuple[Submap, ScanFacts]:
        scans = [self._scans.read(int(s), int(i)) for s, i in zip(selection.session, selection.scan_id, strict=True)]
        sensors = [self._sensors.get(scan.sensor_digest) for scan in scans]
        return build_submap(scans, sensors, selection.visit, job.range_m), _facts(scans)


def _facts(scans: list[Scan]) -> ScanFacts:
    residuals = np.array([scan.alignment_residual_m for scan in scans])
    known = residuals[np.isfinite(residuals)]
    return ScanFacts(
        {scan.stamp_ns: scan.session for scan in scans},
        {scan.stamp_ns: scan.host_ns for scan in scans},
        float(known.mean()) if len(known) else float("nan"),
    )
