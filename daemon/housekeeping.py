"""The housekeeping thread: keeps the data directory within its limits, and copies of what must not be lost."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, replace

from ..storage.backup import back_up_if_due
from ..storage.errors import StorageError
from ..storage.store import Store
from .config import Config
from .instances import submap_scans

logger = logging.getLogger(__name__)

COUNT_S = 10.0  # between two counts of scans and changes
PERIOD_S = 1.0  # between two looks, where no new scan asks for one
AGAIN_S = 60.0  # between two attempts at what failed, and between two lines of log that say the same
# Key scans that may belong to a visit that goes on: it is cut after max_visit_s, at the key scan that follows.
OPEN_VISITS = 1.5


@dataclass(frozen=True)
class Figures:
    """What the store holds, as of the last look."""

    used_bytes: int = 0
    quota_bytes: int = 0
    free_bytes: int = 0
    scans: int = 0
    scans_deleted: int = 0  # since the start
    present_changes: int = 0
    problem: str = ""  # why the limits are not kept, or what had to go


class Housekeeping:
    """Runs beside the writer until it is closed; a context manager. Nothing that fails here ends the thread."""

    def __init__(self, store: Store, config: Config):
        self._store = store
        self.use(config)
        self.figures = Figures()
        self._count_after_s = 0.0
        self._said: dict[str, float] = {}
        self._back_up_after_s = 0.0
        self._stopped = False
        self._thread = threading.Thread(target=self._loop, name="housekeeping", daemon=True)
        self._thread.start()

    def use(self, config: Config) -> None:
        """Other limits, from the next look on; any thread may call it."""
        self._config = config.storage
        self._retention = self._store.retention(
            quota_bytes=round(config.storage.quota_gb * 1e9),
            min_free_bytes=round(config.storage.min_free_gb * 1e9),
            kept_per_visit=submap_scans(config),
            recent_ns=round(OPEN_VISITS * (config.scenes.max_visit_s + config.keyscans.interval_s) * 1e9),
        )

    def close(self) -> None:
        """Finish the step at hand, end the thread, and back up what was found since the last backup."""
        self._stopped = True
        self._store.grown.set()
        self._thread.join()
        self._attempt(lambda: back_up_if_due(self._store.dir, 0.0, self._config.backups_kept))

    def __enter__(self) -> Housekeeping:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def _loop(self) -> None:
        while not self._stopped:
            self._attempt(self._keep_limits)
            self._attempt(self._store.log_places)
            self._attempt(self._back_up)
            self._attempt(self._count)
            self._store.grown.wait(PERIOD_S)
            self._store.grown.clear()
        logger.debug("housekeeping thread exits")

    def _attempt(self, task) -> None:
        try:
            task()
        except (StorageError, OSError) as error:
            self._say(str(error))
        except Exception:
            logger.exception("housekeeping failed")
            time.sleep(PERIOD_S)

    def _keep_limits(self) -> None:
        more = True
        while more and not self._stopped:
            report = self._retention.step()
            more = report.more
            self.figures = replace(
                self.figures,
                used_bytes=report.used_bytes,
                quota_bytes=round(self._config.quota_gb * 1e9),
                free_bytes=report.free_bytes,
                scans_deleted=self.figures.scans_deleted + report.n_deleted,
                problem=report.problem,
            )
            if report.problem:
                self._say(report.problem)

    def _back_up(self) -> None:
        if time.monotonic() >= self._back_up_after_s:
            self._back_up_after_s = time.monotonic() + AGAIN_S
            back_up_if_due(self._store.dir, self._config.backup_interval_h * 3600.0, self._config.backups_kept)

    def _count(self) -> None:
        if time.monotonic() >= self._count_after_s:
            self._count_after_s = time.monotonic() + COUNT_S
            scans, present = self._store.index.count_scans(), self._store.changes.count_present()
            self.figures = replace(self.figures, scans=scans, present_changes=present)

    def _say(self, problem: str) -> None:
        """Warn, but not each second of the same."""
        now = time.monotonic()
        if now - self._said.get(problem, -AGAIN_S) >= AGAIN_S:
            self._said = {problem: now}
            logger.warning("data directory: %s", problem)
