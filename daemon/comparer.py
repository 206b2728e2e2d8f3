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
from .detection.submap import Submap, join
from .sensors import Sensors
from .stopwatch import Stopwatch
from .submap_build import build_submap

MORE_SCANS = 12  # of a side, the nearest to an object beyond those of the submap, are asked for the rest of it


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
        cumulative = update_map(cumulative, job.cumulative.session[job.cumulative.chosen], job.erasures)
        watch.lap("update_map")
        more_cumulative = _More(self, job.cumulative, cumulative, facts_c, job)
        more_recent = _More(self, job.recent, recent, facts_r, job)
        detection = detect(cumulative, recent, job.thresholds, more_cumulative.around, more_recent.around)
        watch.restart()
        limits = job.thresholds.occlusion_margin_m, job.thresholds.occlusion_range_m
        known = [state_of(change, recent.images, *limits) for change in job.known]
        watch.lap("known")
        sizes = len(cumulative.points), len(recent.points)
        return Comparison(detection, known, facts_c, facts_r, *sizes, {**watch.seconds, **detection.seconds})

    def load(self, selection: Selection, range_m: float) -> tuple[Submap, ScanFacts]:
        """The submap of a selection's chosen scans."""
        chosen = selection.only(selection.chosen)
        submap, scans = build_submap(lambda i: self.read(chosen, i), chosen.visit, range_m)
        return submap, _facts(scans)

    def read(self, selection: Selection, i: int) -> tuple[Scan, Sensor]:
        """One scan of a selection and its sensor."""
        scan = self._scans.read(int(selection.session[i]), int(selection.scan_id[i]))
        return scan, self._sensors.get(scan.sensor_digest)


class _More:
    """A side's scans beyond those of its submap: the nearest ones are loaded when an object wants to be completed."""

    def __init__(self, comparer: Comparer, selection: Selection, submap: Submap, facts: ScanFacts, job: Job):
        self._comparer, self._submap, self._facts, self._job = comparer, submap, facts, job
        self._rest = selection.only(~selection.chosen)
        self._loaded: dict[tuple[int, ...], Submap] = {}

    def around(self, lower: np.ndarray, upper: np.ndarray) -> Submap:
        """The points in a box, ground too, of the submap's scans and of those nearest to it."""
        distance = np.linalg.norm(self._rest.position_m - 0.5 * (lower + upper), axis=1)
        nearest = tuple(np.sort(np.argsort(distance, kind="stable")[:MORE_SCANS]).tolist())
        if nearest not in self._loaded:
            self._loaded = {nearest: self._load(self._rest.only(np.array(nearest, np.int64)))}  # one: it takes 20 MB
        return join(self._submap.around(lower, upper), self._loaded[nearest].around(lower, upper))

    def _load(self, selection: Selection) -> Submap:
        submap, scans = build_submap(
            lambda i: self._comparer.read(selection, i), selection.visit, self._job.range_m
        )
        facts = _facts(scans)
        self._facts.session.update(facts.session)
        self._facts.host_ns.update(facts.host_ns)
        return update_map(submap, selection.session, self._job.erasures)


def _facts(scans: list[Scan]) -> ScanFacts:
    residuals = np.array([scan.alignment_residual_m for scan in scans])
    known = residuals[np.isfinite(residuals)]
    return ScanFacts(
        {scan.stamp_ns: scan.session for scan in scans},
        {scan.stamp_ns: scan.host_ns for scan in scans},
        float(known.mean()) if len(known) else float("nan"),
    )
