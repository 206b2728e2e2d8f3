"""One change-detection instance from start to end: select submaps, compare them, record what came of it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..models.descriptor import DescriptorModel
from ..storage.errors import StorageUnavailable
from ..storage.index import InstanceRow, SceneScans
from ..storage.store import Store
from .changes import ChangeManager, Finding
from .comparison import MIN_SCANS, Comparison, Job, Selection
from .config import Config
from .detection.results import DetectedObject, Thresholds
from .detection_process import DetectionProcess, JobFailed, Stopped
from .moments import in_order
from .submaps import select, unshared
from .worker import Instance

logger = logging.getLogger(__name__)

PATIENCE_S, RETRY_S = 75.0, 2.0  # what was found is worth waiting for a full disk or a locked changes.db
REFERENCE_ALPHA_M2 = 120.0  # the scene size at which `submaps.k` is stated; k grows with alpha (CDSD section V)


def submap_scans(config: Config) -> int:
    """How many scans represent a scene of this size."""
    return max(MIN_SCANS, round(config.submaps.k * config.scenes.alpha_m2 / REFERENCE_ALPHA_M2))


class Rejected(Exception):
    """An instance that must not be compared; the message says why."""


class ChangeDetection:
    """Runs instances on stored scans; called by the detection thread alone."""

    def __init__(self, config: Config, store: Store, process: DetectionProcess, model: DescriptorModel):
        self._config = self._wanted = config
        self._store = store
        self._model = model
        self._manager = ChangeManager(store.changes)
        self._process = process
        self.n_changes = 0  # change objects new in this run
        self.hurry = threading.Event()  # set when the program ends: nothing is waited for any more

    @property
    def settings(self) -> str:
        """Digest of the settings in force."""
        return self._config.digest

    def use(self, config: Config) -> None:
        """Other settings, from the next instance on; any thread may call it."""
        self._wanted = config

    def due(self) -> list[Instance]:
        """Instances of visits that ended in earlier runs, and of which no run recorded how it went."""
        return [Instance(**vars(row)) for row in self._store.index.visits_due()]

    def run(self, instance: Instance) -> None:
        """Detect the changes of one visit against all visits before, and record how it went."""
        start = time.perf_counter()
        self._config = self._wanted
        row, where = {"scene_id": instance.scene_id, "visit_id": instance.visit_id}, (instance.scene_id, instance.visit)
        try:
            job = self.job(instance)
            comparison = self._process.compare(job)
        except Stopped:
            logger.info("instance left for the next start: scene=%d visit=%d", *where)
            return
        except (Rejected, JobFailed) as why:
            status = "rejected" if isinstance(why, Rejected) else "failed"
            logger.info("instance %s scene=%d visit=%d: %s", status, *where, why)
            self._note(InstanceRow(**row, status=status, reason=str(why)))
            return
        try:
            n_new = self._patiently(lambda: self._record(comparison, instance))
        except StorageUnavailable as why:
            logger.error("not stored, left for the next start: scene=%d visit=%d: %s", *where, why)
            return
        self.n_changes += n_new
        self._note(
            InstanceRow(
                **row,
                status="done",
                seconds=time.perf_counter() - start,
                stage_seconds=comparison.seconds,
                n_cumulative_scans=int(job.cumulative.chosen.sum()),
                n_recent_scans=int(job.recent.chosen.sum()),
                n_candidates=comparison.detection.n_candidates,
                n_confirmed=comparison.detection.n_confirmed,
                n_changes=n_new,
                alignment_residual_m=comparison.recent.residual_m,
            )
        )

    def _note(self, row: InstanceRow) -> None:
        try:
            self._store.index.record_instance(row)
        except StorageUnavailable as why:
            logger.warning("an instance is not in the record: %s", why)

    def _choose(self, scans: SceneScans) -> Selection:
        """Of the scans whose poses can be trusted in this scene, those that represent the visits best (OptMap)."""
        usable = scans.only((scans.visit_number == 1) | scans.aligned)
        if len(usable.scan_id) < MIN_SCANS:
            raise Rejected(
                f"{len(usable.scan_id)} of {len(scans.scan_id)} scans are aligned to the scene's first visit, "
                f"at least {MIN_SCANS} are needed"
            )
        chosen = np.zeros(len(usable.scan_id), dtype=bool)
        apart = unshared(usable.descriptors, usable.model_id, self._model.overlap_from_distance)
        chosen[select(apart, usable.visit_number, submap_scans(self._config))] = True
        moment = in_order(usable.session, usable.stamp_ns)
        position_m = usable.T_map_sensor[:, :3, 3]
        return Selection(usable.session, usable.scan_id, usable.visit_number, moment, position_m, chosen)

    def job(self, instance: Instance) -> Job:
        """What is to be compared. Raises Rejected where a submap would say too little."""
        index, range_m = self._store.index, self._config.submaps.range_m
        before_visit = index.scans_of_scene(instance.scene_id, before_visit=instance.visit)
        cumulative = self._choose(before_visit)
        recent = self._choose(index.scans_of_scene(instance.scene_id, visit=instance.visit))
        box = cumulative.position_m.min(axis=0) - range_m, cumulative.position_m.max(axis=0) + range_m
        # Not what a neighbouring scene found gone a moment ago: its far view would erase half of a thing, and leave
        # the better view from here the other half to find.
        visited_until = int(before_visit.session[-1]), int(before_visit.stamp_ns[-1]) + 1
        return Job(
            cumulative,
            recent,
            self._manager.erasures(instance.map_id, box, visited_until),
            self._manager.known(instance.map_id, box, (instance.session_id, instance.t_in_ns)),
            range_m,
            Thresholds(**self._config.detection.model_dump()),
        )

    def _patiently(self, record: Callable[[], int]) -> int:
        """Record what was found, as soon as the disk is not full and no other program holds changes.db.

        Raises StorageUnavailable after PATIENCE_S, or when `hurry` is set.
        """
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                return record()
            except StorageUnavailable as why:
                if self.hurry.is_set() or time.monotonic() > until:
                    raise
                logger.error("changes wait to be stored: %s", why)
            self.hurry.wait(RETRY_S)

    def _record(self, comparison: Comparison, instance: Instance) -> int:
        """Hand the objects to the change manager, all of an instance or none; how many of them are new."""
        with self._store.changes.transaction():
            return self._record_all(comparison, instance)

    def _record_all(self, comparison: Comparison, instance: Instance) -> int:
        n_new, before, after = 0, comparison.cumulative, comparison.recent
        for found in comparison.detection.objects:
            finding = Finding(
                instance.map_id,
                instance.session_id,
                instance.scene_id,
                instance.visit,
                after.host_ns[found.after_ns],
                before.session[found.before_ns],
                after.residual_m,
                self._model.model_id,
                self._config.digest,
            )
            found = replace(found, before_ns=before.stamp_ns[found.before_ns], after_ns=after.stamp_ns[found.after_ns])
            n_new += self._manager.record(found, finding)
            _log(found, instance)
        self._manager.note(comparison.known, instance)
        return n_new


def _log(found: DetectedObject, instance: Instance) -> None:
    x, y, z = found.points.mean(axis=0)
    logger.info(
        "change %s at x=%.1f y=%.1f z=%.1f points=%d scene=%d visit=%d",
        found.polarity, x, y, z, len(found.points), instance.scene_id, instance.visit,
        extra={  # fields of the journal
            "POLARITY": found.polarity,
            "SESSION": instance.session_id,
            "SCENE": instance.scene_id,
            "VISIT": instance.visit,
        },
    )  # fmt: skip
