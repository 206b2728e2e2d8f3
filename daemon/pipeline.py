"""The life of one frame, top to bottom: from the sensor's packets to an instance of change detection.

    gate -> odometry -> key scan? -> localization -> descriptor -> scan file and index -> scenes -> instance
                                                                                    -> join to an earlier map

What happens to an instance (submaps, detection, change objects) is in instances.py, on the detection thread.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future
from dataclasses import dataclass, field

from ..drivers.frame import Frame
from ..drivers.gate import FrameGate
from ..models.descriptor import DescriptorModel
from ..storage.errors import StorageUnavailable
from ..storage.rows import InstanceRow
from ..storage.scans import Scan
from ..storage.store import Store
from .config import Config
from .joining import Join, Joiner, Locate
from .localization import Fix
from .memory import return_freed
from .odometry import Health, Motion
from .relocalization import Answer, Question
from .scenes import SceneUpdate
from .sensors import Sensors
from .session import Session
from .sweep import sweep_of
from .worker import DetectionWorker

logger = logging.getLogger(__name__)

PREPARE_M = 6.0  # a scene's first visit is read over its ten scans' worth of key scans, so far before it is entered


@dataclass
class Counts:
    """What the pipeline has done since it started."""

    frames: int = 0
    rejected: int = 0
    key_scans: int = 0
    not_stored: int = 0  # key scans that the disk did not take
    scenes: int = 0
    instances: int = 0
    odometry_lost: int = 0
    joined_maps: list[int] = field(default_factory=list)  # one for each session that found its place in an earlier map
    join_attempts: int = 0


@dataclass(frozen=True)
class Now:
    """Where the pipeline is, for whoever watches it."""

    session_id: int
    map_id: int
    scenes: tuple[int, ...]  # those that the robot is in
    health: Health  # of the odometry, at the last frame


class Pipeline:
    """Takes frames one by one. wait: what to do when the detection lags, wait for it or drop an instance."""

    def __init__(
        self,
        config: Config,
        store: Store,
        sensors: Sensors,
        model: DescriptorModel,
        worker: DetectionWorker,
        locate: Locate,
        source: str,
        wait: bool,
    ):
        self.counts = Counts()
        self.gate = FrameGate(config.gate.min_valid_ratio)
        self._config, self._store, self._sensors = config, store, sensors
        self._model, self._worker, self._locate = model, worker, locate
        self._source, self._wait = source, wait
        self._session: Session | None = None
        self._joiner: Joiner | None = None  # of a session in a map of its own
        self._health = Health.GOOD
        self.disk_problem = ""  # why the last key scan was not stored; empty where it was

    def process(self, frame: Frame) -> None:
        """One rotation of the sensor."""
        self.counts.frames += 1
        rejection = self.gate.check(frame)
        if self.gate.interruption:
            logger.warning("a new session begins: %s", self.gate.interruption)
            self.finish()
        if rejection is not None:
            self.counts.rejected += 1
            return
        try:
            self._follow(frame)
        except StorageUnavailable as error:
            self._do_without(error)

    def _follow(self, frame: Frame) -> None:
        """Find where the robot is, and keep the frame if it shows something new. Raises StorageUnavailable."""
        session = self._session or self._start_session(frame)
        motion = session.odometry.register(frame)
        self._health = motion.health
        if motion.health.lost:
            self._lose_session(motion)
        elif session.key_scans.wants(motion.T_odom_sensor, frame.stamp_ns):
            self._keep(session, frame, motion)

    def finish(self) -> None:
        """The source has ended: close the scene being made and the visits, and queue what is due."""
        if self._session is None:
            return
        try:
            self._note(self._session, self._session.scenes.finish())
            self._store.index.end_session(self._session.session_id)
        except StorageUnavailable as error:
            self._do_without(error)
        self._session = None

    def now(self) -> Now | None:
        """The session at hand; None between two."""
        session = self._session
        if session is None:
            return None
        return Now(session.session_id, session.map_id, tuple(sorted(session.scenes.open_visits)), self._health)

    def _keep(self, session: Session, frame: Frame, motion: Motion) -> None:
        """A key scan: find where it is, describe it, store it, and tell the scenes."""
        alignment = self._config.alignment
        sweep = sweep_of(frame, frame.sensor, alignment.range_m, alignment.cell_m)
        fix = session.localizer.locate(sweep, motion, session.scenes_to_align_with(motion.T_odom_sensor))
        session.localizer.prepare(session.scenes_to_align_with(motion.T_odom_sensor, PREPARE_M))
        scan = self._scan(session, frame, motion, fix)
        self._store.add_scan(scan)
        self.counts.key_scans += 1
        if self.disk_problem:
            logger.info("key scans are stored again")
            self.disk_problem = ""
        self._note(
            session, session.scenes.update(scan.scan_id, scan.stamp_ns, fix.T_map_sensor[:2, 3], scan.descriptor)
        )
        join = self._joiner.update(scan) if self._joiner is not None else None
        if join is not None:
            self._go_on_in(join, session)

    def _do_without(self, error: StorageUnavailable) -> None:
        """The disk is full, or fails, or somebody holds a database: a robot drives on, and so does its odometry."""
        self.counts.not_stored += 1
        if str(error) != self.disk_problem:
            logger.warning("a key scan was not stored: %s", error)
        self.disk_problem = str(error)

    def _scan(self, session: Session, frame: Frame, motion: Motion, fix: Fix) -> Scan:
        sensor = frame.sensor
        return Scan(
            scan_id=self._store.new_scan_id(),
            session=session.session_id,
            stamp_ns=frame.stamp_ns,
            host_ns=frame.host_ns,
            frame_id=frame.frame_id,
            sensor_digest=sensor.digest,
            range_mm=frame.range_mm,
            reflectivity=frame.reflectivity,
            column_ns=frame.column_ns,
            column_valid=frame.column_valid,
            T_map_sensor=fix.T_map_sensor,
            T_odom_sensor=motion.T_odom_sensor,
            T_start_end=fix.T_start_end,
            descriptor=self._model.describe(frame.range_mm, sensor.pixel_shift, sensor.altitude_rad),
            model_id=self._model.model_id,
            aligned=fix.aligned,
            alignment_residual_m=fix.residual_m,
        )

    def _note(self, session: Session, update: SceneUpdate) -> None:
        """Store new scenes and ended visits, and queue an instance for each visit to a known scene."""
        self.counts.scenes += update.new_scene is not None
        for instance in session.record(update):
            self.counts.instances += 1
            if not self._worker.submit(instance, self._wait):
                full = "the detection's queue was full"
                self._store.index.record_instance(InstanceRow(instance.scene_id, instance.visit_id, "dropped", full))
        if update.ended_visits:
            return_freed()

    def _start_session(self, frame: Frame) -> Session:
        maps = self._store.index.maps_to_join()
        self._joiner = Joiner(self._ask_where, maps, self._config.alignment, self._wait) if maps else None
        beta = float(self._model.distance_from_overlap(self._config.scenes.min_overlap))
        self._session = Session(self._config, self._store, self._sensors, frame.sensor, self._source, beta)
        sensor = frame.sensor
        logger.info(
            "session %d starts sensor=%s clock=%s host_ahead_s=%.3f",
            self._session.session_id,
            sensor.serial,
            sensor.timestamp_mode,
            frame.clock_offset_ns * 1e-9,
        )
        return self._session

    def _ask_where(self, question: Question) -> Future[Answer]:
        self.counts.join_attempts += 1
        return self._locate(question)

    def _go_on_in(self, join: Join, session: Session) -> None:
        """The session's place in an earlier map is known: end its own map, and go on in that one without a break."""
        self.finish()
        self._joiner, self._session = None, session.joined(join)
        self.counts.joined_maps.append(join.map_id)
        logger.info("session %d continues %d in map %d", self._session.session_id, session.session_id, join.map_id)

    def _lose_session(self, motion: Motion) -> None:
        """Without odometry nothing may be compared across the break: close the session; the next frame starts one."""
        logger.warning("odometry lost: %s", motion.health.value)
        self.counts.odometry_lost += 1
        self.finish()
