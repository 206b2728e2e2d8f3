"""revisitd as a service: one sensor, kept open for months, through the whole program; signals, watchdog, status.

The loop turns over at least once a second, with a frame or without, and systemd's watchdog is fed from it and nowhere
else: a frame that never ends, or a detection long past its deadline, is not alive.
"""

from __future__ import annotations

import faulthandler
import logging
import signal
import threading
import time
from pathlib import Path

from ..drivers.kept import KeptSource
from .board import StatusBoard
from .config import Config, load_config
from .notify import notify, notify_reloading, watchdog_interval_s
from .program import Program

logger = logging.getLogger(__name__)

STOP_S = 8.0  # for the instance at hand; systemd and users wait ten
SILENT_S = 5.0  # without a frame the odometry is lost anyway: the visits so far are compared now
RELOADED = ("detection", "storage")  # sections that take effect without a restart


class Service:
    """What `revisitd run` runs.

    address: the sensor's. config_path: where the settings are read again at SIGHUP; None: there are none.
    """

    def __init__(self, data: Path, address: str, config: Config, config_path: Path | None):
        self._data, self._address, self._config, self._config_path = data, address, config, config_path
        self._stop, self._reload = threading.Event(), threading.Event()

    def run(self) -> None:
        """Until SIGTERM or SIGINT. Raises the storage's errors and ModelError at the start."""
        faulthandler.enable()  # the watchdog's SIGABRT: the journal shows what each thread was at
        self._listen_to_signals()
        notify("STATUS=opening the store")
        with Program(self._data, self._config, self._address, wait=False) as program:
            source = KeptSource(self._address, self._config.sensor.wish, self._stop)
            board = StatusBoard(self._data, program, source, self._address)
            notify("READY=1")
            logger.info("revisitd serves %s, data in %s", self._address, self._data)
            self._loop(program, source, board)
            notify("STOPPING=1", "STATUS=stopping: the instance at hand may finish")
            program.stop(STOP_S)
            board.clear()
        logger.info("revisitd has stopped")

    def _loop(self, program: Program, source: KeptSource, board: StatusBoard) -> None:
        watchdog = _Watchdog(program, self._config.worker.timeout_s)
        heard = time.monotonic()
        for frame in source:
            if frame is not None:
                program.pipeline.process(frame)
                heard = time.monotonic()
            elif program.pipeline.now() is not None and time.monotonic() - heard > SILENT_S:
                logger.warning("no frame for %.0f s: the session is closed", SILENT_S)
                program.pipeline.finish()
            if self._reload.is_set():
                self._reload.clear()
                self._reload_settings(program)
            board.turn(program.pipeline.now())
            watchdog.turn()

    def _listen_to_signals(self) -> None:
        for stop in (signal.SIGTERM, signal.SIGINT):
            signal.signal(stop, lambda *_: self._stop.set())
        signal.signal(signal.SIGHUP, lambda *_: self._reload.set())

    def _reload_settings(self, program: Program) -> None:
        """Read the settings again; those that need a restart are named, and wrong ones change nothing."""
        notify_reloading()
        try:
            wanted = load_config(self._config_path)
        except Exception as error:  # a service goes on with what it has
            logger.error("settings not reloaded, the old ones stay in force: %s", error)
        else:
            changed = [name for name, section in wanted if section != getattr(self._config, name)]
            taken = [name for name in changed if name in RELOADED]
            self._config = self._config.model_copy(update={name: getattr(wanted, name) for name in taken})
            program.detection.use(self._config)
            program.housekeeping.use(self._config)
            waiting = [name for name in changed if name not in RELOADED]
            logger.info("settings reloaded: %s changed", ", ".join(taken) or "nothing")
            if waiting:
                logger.warning("these settings take effect after a restart only: %s", ", ".join(waiting))
        notify("READY=1")


class _Watchdog:
    """Tells systemd that we are alive, as often as it wants to hear it and as long as the detection is not stuck."""

    GRACE = 2.0  # a job past its deadline is ended by the detection itself; twice as long, and that failed too

    def __init__(self, program: Program, timeout_s: float):
        self._program, self._timeout_s = program, timeout_s
        self._interval_s = watchdog_interval_s()
        self._fed = 0.0

    def turn(self) -> None:
        """Once for each turn of the frame loop."""
        now = time.monotonic()
        if self._interval_s is None or now - self._fed < self._interval_s:
            return
        if self._program.worker.busy_s > self.GRACE * self._timeout_s:
            logger.error("the detection is stuck for %.0f s: the watchdog is not fed", self._program.worker.busy_s)
            return
        notify("WATCHDOG=1")
        self._fed = now
