"""The heavy half of an instance: load two sets of scans, bring them up to date, and compare them.

It runs in a process of its own (detection_process.py): KISS-ICP and GICP hold the interpreter's lock for tens of
milliseconds, and beside them every numpy call here would wait for it (five times the time, measured). numba, which
compiles its loops, takes 60 MB: only that process imports this module.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..drivers.frame import Sensor
from ..storage.datadir import DataDir
from ..storage.errors import ScanFileError
from ..storage.scans import Scan, ScanStore
from .comparison import MIN_SCANS, Comparison, Job, ScanFacts, Selection
from .detection.detector import Side, detect, side_of
from .detection.erasure import update_map
from .detection.occlusion import state_of
from .detection.results import Erasure
from .detection.submap import Submap
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
        """Raises ScanFileError where too few scans of a side can be read."""
        watch = Stopwatch()
        before, n_before, facts_before = self._side(job.cumulative, job, watch)
        now, n_now, facts_now = self._side(job.recent, job, watch)
        detection = detect(before, now, job.thresholds)
        watch.restart()
        limits = job.thresholds.occlusion_margin_m, job.thresholds.occlusion_range_m
        known = [state_of(change, now.standing.images, *limits) for change in job.known]
        watch.lap("known")
        seconds = {**watch.seconds, **detection.seconds}
        return Comparison(detection, known, facts_before, facts_now, n_before, n_now, seconds)

    def _side(self, selection: Selection, job: Job, watch: Stopwatch) -> tuple[Side, int, ScanFacts]:
        """One side of the comparison; how many points it has with its ground, which are not kept."""
        submap, facts, loaded = self.load(selection.only(selection.chosen), job.range_m)
        if len(loaded.scan_id) < MIN_SCANS:
            raise ScanFileError(f"{len(loaded.scan_id)} of {selection.chosen.sum()} scans can be read: too few")
        watch.lap("load")
        submap = _updated(submap, loaded, job.erasures)
        watch.lap("update_map")
        side = side_of(submap, job.thresholds, _More(self, selection, facts, job).around)
        watch.lap("ground")
        return side, len(submap.points), facts

    def load(self, selection: Selection, range_m: float) -> tuple[Submap, ScanFacts, Selection]:
        """The submap of those scans of a selection that can be read, and which these are."""
        submap, scans, there = build_submap(lambda i: self.read(selection, i), selection.visit, range_m)
        loaded = selection.only(there)
        return submap, _facts(scans, loaded.moment), loaded

    def read(self, selection: Selection, i: int) -> tuple[Scan, Sensor]:
        """One scan of a selection and its sensor."""
        scan = self._scans.read(int(selection.session[i]), int(selection.scan_id[i]))
        return scan, self._sensors.get(scan.sensor_digest)


class _More:
    """A side's scans beyond those of its submap: the nearest ones are loaded when an object wants to be completed."""

    def __init__(self, comparer: Comparer, selection: Selection, facts: ScanFacts, job: Job):
        self._comparer, self._facts, self._job = comparer, facts, job
        self._rest = selection.only(~selection.chosen)
        self._loaded: dict[tuple[int, ...], Submap] = {}

    def around(self, lower: np.ndarray, upper: np.ndarray) -> Submap:
        """The points in a box, ground too, of the scans nearest to it."""
        distance = np.linalg.norm(self._rest.position_m - 0.5 * (lower + upper), axis=1)
        nearest = tuple(np.sort(np.argsort(distance, kind="stable")[:MORE_SCANS]).tolist())
        if nearest not in self._loaded:
            self._loaded = {nearest: self._load(self._rest.only(np.array(nearest, np.int64)))}  # one: it takes 20 MB
        return self._loaded[nearest].around(lower, upper)

    def _load(self, selection: Selection) -> Submap:
        submap, facts, loaded = self._comparer.load(selection, self._job.range_m)
        self._facts.session.update(facts.session)
        self._facts.stamp_ns.update(facts.stamp_ns)
        self._facts.host_ns.update(facts.host_ns)
        return _updated(submap, loaded, self._job.erasures)


def _updated(submap: Submap, selection: Selection, erasures: list[Erasure]) -> Submap:
    """The submap of a selection's scans without what is known to be gone, its times in order over all sessions."""
    return replace(update_map(submap, selection.session, erasures), stamp_ns=selection.moment)


def _facts(scans: list[Scan], moment: np.ndarray) -> ScanFacts:
    residuals = np.array([scan.alignment_residual_m for scan in scans])
    known = residuals[np.isfinite(residuals)]
    by_moment = dict(zip(moment.tolist(), scans, strict=True))
    return ScanFacts(
        {at: scan.session for at, scan in by_moment.items()},
        {at: scan.stamp_ns for at, scan in by_moment.items()},
        {at: scan.host_ns for at, scan in by_moment.items()},
        float(known.mean()) if len(known) else float("nan"),
    )
