"""Puts the status together while the service runs, and shows it: status.json, Prometheus, systemd's STATUS=."""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from pathlib import Path

from .. import __version__
from ..drivers.kept import KeptSource
from .memory import resident_bytes
from .metrics import METRICS_FILE, write_metrics
from .notify import notify
from .pipeline import Now
from .program import Program
from .status import (
    DetectionStatus,
    FrameStatus,
    PlaceStatus,
    SensorStatus,
    Status,
    StoreStatus,
    status_path,
    write_status,
)

logger = logging.getLogger(__name__)

EVERY_S = 1.0
RATE_S = 10.0  # over which the frame rate and the losses are told
SLOW = 0.8  # of the sensor's rate: less is worth a word


class StatusBoard:
    """Called from the frame loop; writes once a second, and costs a millisecond then."""

    def __init__(self, data: Path, program: Program, source: KeptSource, address: str):
        self._data, self._program, self._source, self._address = data, program, source, address
        self._path = status_path(data)
        self._started_ns = time.time_ns()
        self._shown = 0.0
        self._failed = False
        self._rates: deque[tuple[float, int, int]] = deque([(time.monotonic(), 0, 0)])  # time, frames, columns missing

    def clear(self) -> None:
        """The service ends: what it wrote of itself is not true any more."""
        for path in (self._path, self._path.with_name(METRICS_FILE)):
            path.unlink(missing_ok=True)

    def turn(self, now: Now | None) -> None:
        """Once for each turn of the loop."""
        if time.monotonic() - self._shown < EVERY_S:
            return
        self._shown = time.monotonic()
        status = self._status(now)
        notify(f"STATUS={status.line}")
        try:
            write_status(self._path, status)
            write_metrics(self._path.with_name(METRICS_FILE), status)
            self._failed = False
        except OSError as error:
            if not self._failed:  # the disk may be full for hours: say so once
                logger.warning("the status cannot be written: %s", error)
            self._failed = True

    def _status(self, now: Now | None) -> Status:
        frames, sensor, detection = self._frames(), self._sensor(), self._detection()
        place, store = self._place(now), self._store()
        state, line = _line(sensor, frames, place, detection, store)
        program = self._program
        return Status(
            state,
            line,
            __version__,
            os.getpid(),
            self._started_ns,
            time.time_ns(),
            program.model.model_id,
            program.detection.settings,
            sensor,
            frames,
            place,
            detection,
            store,
        )

    def _sensor(self) -> SensorStatus:
        state, sensor, known = self._source.state, self._source.state.sensor, {}
        telemetry = self._source.telemetry
        if sensor is not None:
            known = {
                "serial": sensor.serial,
                "product": sensor.product,
                "firmware": sensor.firmware,
                "profile": sensor.profile,
                "mode": sensor.mode,
                "clock": sensor.timestamp_mode,
            }
        if telemetry is not None:
            known |= {
                "temperature_c": telemetry.temperature_c,
                "alerts": telemetry.alerts,
                "clock_synced": telemetry.clock_synced,
            }
        return SensorStatus(self._address, state.phase, state.problem, state.since_ns, state.n_opened, **known)

    def _frames(self) -> FrameStatus:
        counts, gate = self._program.pipeline.counts, self._program.pipeline.gate
        now = time.monotonic()
        self._rates.append((now, counts.frames, gate.columns_missing))
        while len(self._rates) > 2 and now - self._rates[0][0] > RATE_S:
            self._rates.popleft()
        then, frames, missing = self._rates[0]
        n_frames = counts.frames - frames
        sensor = self._source.state.sensor
        n_columns = n_frames * int(sensor.in_window.sum()) if sensor else 0
        losses = {**self._source.losses, **gate.losses}
        return FrameStatus(
            hz=round(n_frames / max(now - then, 1e-3), 2),
            received=counts.frames,
            rejected=counts.rejected,
            not_stored=counts.not_stored,
            lost_share=round((gate.columns_missing - missing) / n_columns, 5) if n_columns else 0.0,
            losses={str(cause): count for cause, count in losses.items() if count},
        )

    def _place(self, now: Now | None) -> PlaceStatus:
        counts = self._program.pipeline.counts
        return PlaceStatus(
            odometry=now.health.value if now else "",
            times_lost=counts.odometry_lost,
            session_id=now.session_id if now else None,
            map_id=now.map_id if now else None,
            scenes=now.scenes if now else (),
            key_scans=counts.key_scans,
            joined_maps=tuple(counts.joined_maps),
        )

    def _detection(self) -> DetectionStatus:
        worker, figures = self._program.worker, self._program.housekeeping.figures
        return DetectionStatus(
            busy_s=round(worker.busy_s, 1),
            waiting=worker.n_waiting,
            done=worker.done,
            failed=worker.failed,
            dropped=worker.dropped,
            new_changes=self._program.detection.n_changes,
            present_changes=figures.present_changes,
        )

    def _store(self) -> StoreStatus:
        figures = self._program.housekeeping.figures
        return StoreStatus(
            data=str(self._data.resolve()),
            used_bytes=figures.used_bytes,
            quota_bytes=figures.quota_bytes,
            free_bytes=figures.free_bytes,
            problem=self._program.pipeline.disk_problem or figures.problem,
            repairs=tuple(self._program.store.repairs),
            scans=figures.scans,
            scans_deleted=figures.scans_deleted,
            memory_bytes=resident_bytes("self"),
            detection_memory_bytes=resident_bytes(self._program.process.pid),
        )


def _line(
    sensor: SensorStatus, frames: FrameStatus, place: PlaceStatus, detection: DetectionStatus, store: StoreStatus
) -> tuple[str, str]:
    """One word, and one line that a person can read in `systemctl status`."""
    if sensor.phase != "running":
        return "waiting", f"{sensor.phase}: {sensor.problem or sensor.address}"
    figures = (
        f"{frames.hz:.1f} Hz, loss {frames.lost_share:.1%}, scene {', '.join(map(str, place.scenes)) or '-'}, "
        f"{detection.present_changes} changes, {store.free_bytes / 1e9:.0f} GB free"
    )
    if frames.received == 0 or not place.odometry:
        return "waiting", f"no usable frame yet, {figures}"
    if place.odometry != "good":
        return "lost", f"odometry lost ({place.odometry}), {figures}"
    problem = sensor.problem or store.problem
    wanted_hz = float(sensor.mode.partition("x")[2] or 0)
    if not problem and frames.hz < SLOW * wanted_hz:
        problem = f"only {frames.hz:.1f} of {wanted_hz:.0f} Hz are used"
    if problem:
        return "degraded", f"{problem}, {figures}"
    return "running", f"good {figures}"
