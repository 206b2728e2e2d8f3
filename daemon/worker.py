"""The detection thread behind a bounded queue."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Instance:
    """One change-detection instance: a scene, and the visit that just ended (CDSD section III-A)."""

    session_id: int
    map_id: int
    scene_id: int
    visit_id: int
    visit: int  # v of the paper, at least 2
    t_in_ns: int
    t_out_ns: int


class DetectionWorker:
    """Runs instances one after another on its own thread.

    Policy of the queue: `submit(wait=True)` (replay) blocks while it is full, so nothing is ever dropped;
    `submit(wait=False)` (a live robot) drops the newest instance and counts it in `dropped`.
    """

    def __init__(self, run: Callable[[Instance], None], queue_size: int):
        self._run = run
        self._queue: queue.Queue[Instance | None] = queue.Queue(queue_size)
        self._thread = threading.Thread(target=self._loop, name="detection", daemon=True)
        self.done = 0
        self.failed = 0
        self.dropped = 0
        self._thread.start()

    def submit(self, instance: Instance, wait: bool) -> bool:
        """Queue an instance; False when it was dropped."""
        try:
            self._queue.put(instance, block=wait)
        except queue.Full:
            self.dropped += 1
            logger.warning("dropped instance scene=%d visit=%d: queue full", instance.scene_id, instance.visit)
            return False
        return True

    def drain(self) -> None:
        """Wait until every queued instance is done."""
        self._queue.join()

    def close(self) -> None:
        """Finish what is queued and end the thread."""
        self._queue.put(None)
        self._thread.join()

    def _loop(self) -> None:
        while (instance := self._queue.get()) is not None:
            try:
                self._run(instance)
                self.done += 1
            except Exception:  # one bad scene must not end the detection of all others
                self.failed += 1
                logger.exception("instance failed scene=%d visit=%d", instance.scene_id, instance.visit)
            finally:
                self._queue.task_done()
        self._queue.task_done()
        logger.debug("detection thread exits")
