"""One change-detection instance from start to end: select submaps, load, bring up to date, detect, record."""

from __future__ import annotations

import logging
import time

import numpy as np

from ..storage.index import InstanceRow, SceneScans
from ..storage.scans import Scan
from ..storage.store import Store
from .changes import ChangeManager, Finding
from .config import Config
from .detection.detector import DetectedObject, Detection, Stopwatch, Thresholds, detect
from .detection.submap import Submap
from .sensors import Sensors
from .submaps import select
from .views import build_submap
from .worker import Instance

logger = logging.getLogger(__name__)

MIN_SCANS = 4  # a submap of fewer says too little: most false changes come from visits that only touch a scene
REFERENCE_ALPHA_M2 = 120.0  # the scene size at which `submaps.k` is stated; k grows with alpha (CDSD section V)


class Rejected(Exception):
    """An instance that must not be compared; the message says why."""


class ChangeDetection:
    """Runs instances on stored scans; called by the detection thread alone."""

    def __init__(self, config: Config, store: Store, sensors: Sensors):
        self._config = config
        self._store = store
        self._sensors = sensors
        self._manager = ChangeManager(store.changes)
        self._thresholds = Thresholds(**config.detection.model_dump())
        self.n_changes = 0  # change objects new in this run

    def run(self, instance: Instance) -> None:
        """Detect the changes of one visit against all visits before, and record how it went."""
        start, watch = time.perf_counter(), Stopwatch()
        before = self._usable(self._store.index.scans_of_scene(instance.scene_id, before_visit=instance.visit))
        recent = self._usable(self._store.index.scans_of_scene(instance.scene_id, visit=instance.visit))
        row = {"scene_id": instance.scene_id, "visit_id": instance.visit_id}
        try:
            chosen_c, chosen_r = self._choose(before), self._choose(recent)
        except Rejected as why:
            logger.info("instance rejected scene=%d visit=%d: %s", instance.scene_id, instance.visit, why)
            self._store.index.record_instance(InstanceRow(**row, status="rejected", reason=str(why)))
            return
        watch.lap("optmap")
        cumulative, scans_c = self._load(before, chosen_c)
        recents, scans_r = self._load(recent, chosen_r)
        watch.lap("load")
        cumulative = self._up_to_date(cumulative, scans_c, instance)
        watch.lap("update_map")
        detection = detect(cumulative, recents, self._thresholds)
        residual_m = float(np.nanmean([scan.alignment_residual_m for scan in scans_r]))
        n_new = self._record(detection, instance, scans_c, scans_r, residual_m)
        self.n_changes += n_new
        watch.lap("detect")
        seconds = {**watch.seconds, **detection.seconds}
        del seconds["detect"]
        self._store.index.record_instance(
            InstanceRow(
                **row,
                status="done",
                seconds=time.perf_counter() - start,
                stage_seconds=seconds,
                n_cumulative_scans=len(scans_c),
                n_recent_scans=len(scans_r),
                n_candidates=detection.n_candidates,
                n_confirmed=detection.n_confirmed,
                n_changes=n_new,
                alignment_residual_m=residual_m,
            )
        )

    @staticmethod
    def _usable(scans: SceneScans) -> SceneScans:
        """The scans whose poses can be trusted in this scene: the first visit's, and aligned ones."""
        return scans.only((scans.visit_number == 1) | scans.aligned)

    def _choose(self, scans: SceneScans) -> np.ndarray:
        """Rows of the scans that represent these visits best (OptMap)."""
        if len(scans.scan_id) < MIN_SCANS:
            raise Rejected(f"{len(scans.scan_id)} aligned scans, at least {MIN_SCANS} are needed")
        k = max(MIN_SCANS, round(self._config.submaps.k * self._config.scenes.alpha_m2 / REFERENCE_ALPHA_M2))
        return select(scans.descriptors, scans.visit_number, k)

    def _load(self, scans: SceneScans, chosen: np.ndarray) -> tuple[Submap, list[Scan]]:
        loaded = [self._store.scans.read(int(scans.session[i]), int(scans.scan_id[i])) for i in chosen]
        sensors = [self._sensors.get(scan.sensor_digest) for scan in loaded]
        return build_submap(loaded, sensors, scans.visit_number[chosen], self._config.submaps.range_m), loaded

    def _up_to_date(self, cumulative: Submap, scans: list[Scan], instance: Instance) -> Submap:
        """The cumulative submap without what was known, before this visit, to have gone."""
        taken = np.array([[scan.session, scan.stamp_ns] for scan in scans])[cumulative.scan]
        until = (instance.session_id, instance.t_in_ns)
        return cumulative.only(self._manager.update_map(cumulative.points, taken, instance.map_id, until))

    def _record(
        self, detection: Detection, instance: Instance, scans_c: list[Scan], scans_r: list[Scan], residual_m: float
    ) -> int:
        """Hand the objects to the change manager; how many of them are new."""
        host_ns = {scan.stamp_ns: scan.host_ns for scan in scans_r}
        session_of = {scan.stamp_ns: scan.session for scan in scans_c}
        n_new = 0
        for found in detection.objects:
            finding = Finding(
                instance.map_id,
                instance.session_id,
                instance.scene_id,
                instance.visit,
                host_ns[found.after_ns],
                session_of[found.before_ns],
                residual_m,
                scans_r[0].model_id,
                self._config.digest,
            )
            n_new += self._manager.record(found, finding)
            _log(found, instance)
        return n_new


def _log(found: DetectedObject, instance: Instance) -> None:
    x, y, z = found.points.mean(axis=0)
    logger.info(
        "change %s at x=%.1f y=%.1f z=%.1f points=%d scene=%d visit=%d",
        found.polarity, x, y, z, len(found.points), instance.scene_id, instance.visit,
    )  # fmt: skip
