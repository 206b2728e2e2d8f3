"""The heavy half of an instance: load two sets of scans, bring them up to date, and compare them.

It runs in a process of its own (detection_process.py): KISS-ICP and GICP hold the interpreter's lock for tens of
milliseconds, and beside them every numpy call here would wait for it (five times the time, measured). numba, which
compiles its loops, takes 60 MB: only that process imports this module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..drivers.frame import Sensor
from ..storage.datadir import DataDir
from ..storage.scans import Scan, ScanStore
from .comparison import Comparison, Job, ScanFacts, Selection
from .detection.detector import detect
from .detection.erasure import update_map
from .detection.occlusion import state_of
from .detection.submap import Submap
from .sensors import Sensors
from .stopwatch import Stopwatch
from .submap_build import build_submap


class Comparer:
    """Compares scans of one data directory; keeps the sensors' geometries between jobs."""

    def __init__(self, data: Path):
        directory = DataDir.open_reader(data)
        self._scans = ScanStore(directory.scans_path)
        self._sensors = Sensors(directory)

    def compare(self, job: Job) -> Comparison:
        """Raises ScanFileError where a scan's file is damaged or gone."""
        watch = Stopwatch()
        cumulative, facts_c = self.load(job.cumulative, job.range_m)
        recent, facts_r = self.load(job.recent, job.range_m)
        watch.lap("load")
        cumulative = update_map(cumulative, job.cumulative.session, job.erasures)
        watch.lap("update_map")
        detection = detect(cumulative, recent, job.thresholds)
        watch.restart()
        limits = job.thresholds.occlusion_margin_m, job.thresholds.occlusion_range_m
        known = [state_of(change, recent.images, *limits) for change in job.known]
        watch.lap("known")
        sizes = len(cumulative.points), len(recent.points)
        return Comparison(detection, known, facts_c, facts_r, *sizes, {**watch.seconds, **detection.seconds})

    def load(self, selection: Selection, range_m: float) -> tuple[Submap, ScanFacts]:
        """The submap of some stored scans."""

        def read(i: int) -> tuple[Scan, Sensor]:
            scan = self._scans.read(int(selection.session[i]), int(selection.scan_id[i]))
            return scan, self._sensors.get(scan.sensor_digest)

        submap, scans = build_submap(read, selection.visit, range_m)
        return submap, _facts(scans)


def _facts(scans: list[Scan]) -> ScanFacts:
    residuals = np.array([scan.alignment_residual_m for scan in scans])
    known = residuals[np.isfinite(residuals)]
    return ScanFacts(
        {scan.stamp_ns: scan.session for scan in scans},
        {scan.stamp_ns: scan.host_ns for scan in scans},
        float(known.mean()) if len(known) else float("nan"),
    )
