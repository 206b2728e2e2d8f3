"""The detection thread behind a bounded queue."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
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
    backlog: instances of earlier runs; they are run when the queue is empty.
    """

    def __init__(self, run: Callable[[Instance], None], queue_size: int, backlog: Iterable[Instance] = ()):
        self._run = run
        self._size = queue_size
        self._queue: deque[Instance] = deque()
        self._backlog = deque(backlog)
        self._changed = threading.Condition()
        self._begun: float | None = None  # monotonic, of the instance at hand
        self._ending = False
        self.done = 0
        self.failed = 0
        self.dropped = 0
        self._thread = threading.Thread(target=self._loop, name="detection", daemon=True)
        self._thread.start()

    @property
    def n_waiting(self) -> int:
        """Instances not begun yet, those of earlier runs among them."""
        return len(self._queue) + len(self._backlog)

    @property
    def busy_s(self) -> float:
        """How long the instance at hand has taken so far; 0 without one."""
        begun = self._begun
        return 0.0 if begun is None else time.monotonic() - begun

    def submit(self, instance: Instance, wait: bool) -> bool:
        """Queue an instance; False when it was dropped."""
        with self._changed:
            if wait:
                self._changed.wait_for(lambda: len(self._queue) < self._size)
            elif len(self._queue) >= self._size:
                self.dropped += 1
                logger.warning("dropped instance scene=%d visit=%d: queue full", instance.scene_id, instance.visit)
                return False
            self._queue.append(instance)
            self._changed.notify_all()
        return True

    def drain(self) -> None:
        """Wait until every instance is done."""
        with self._changed:
            self._changed.wait_for(lambda: self.n_waiting == 0 and self._begun is None)

    def stop(self, within_s: float) -> bool:
        """Begin no further instance; False where the one at hand is not done in time."""
        with self._changed:
            self._queue.clear()
            self._backlog.clear()
            self._changed.notify_all()
            return self._changed.wait_for(lambda: self._begun is None, within_s)

    def close(self) -> None:
        """Finish what is queued and end the thread."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()

    def _loop(self) -> None:
        while (instance := self._next()) is not None:
            try:
                self._run(instance)
                self.done += 1
            except Exception:  # one bad scene must not end the detection of all others
                self.failed += 1
                logger.exception("instance failed scene=%d visit=%d", instance.scene_id, instance.visit)
            finally:
                with self._changed:
                    self._begun = None
                    self._changed.notify_all()
        logger.debug("detection thread exits")

    def _next(self) -> Instance | None:
        """The next instance, when there is one; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self.n_waiting or self._ending)
            if not self.n_waiting:
                return None
            self._begun = time.monotonic()
            instance = self._queue.popleft() if self._queue else self._backlog.popleft()
            self._changed.notify_all()
            return instance
