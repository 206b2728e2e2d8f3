"""What has to be done beside the frames: keep the disk's quota, back up the changes, count what there is."""

from __future__ import annotations

import logging
import shutil
import threading
from dataclasses import dataclass

from ..storage.errors import StorageError
from ..storage.store import Store

logger = logging.getLogger(__name__)

EVERY_S = 5.0


@dataclass(frozen=True)
class Figures:
    """What the store holds, as of the last round."""

    used_bytes: int = 0
    quota_bytes: int = 0
    free_bytes: int = 0
    scans: int = 0
    scans_removed: int = 0  # by retention, since the start
    last_backup_host_ns: int | None = None
    present_changes: int = 0


class Housekeeper:
    """A thread of its own beside the frame loop. A context manager."""

    def __init__(self, store: Store):
        self.figures = Figures()
        self._store = store
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="housekeeping", daemon=True)

    def _loop(self) -> None:
        while not self._stop.is_set():
            try:
                self._round()
            except (StorageError, OSError) as error:  # a full or failing disk: again in the next round
                logger.warning("housekeeping: %s", error)
            self._stop.wait(EVERY_S)

    def _round(self) -> None:
        counts = self._store.index.counts()
        self.figures = Figures(
            used_bytes=counts["scan_bytes"],
            free_bytes=shutil.disk_usage(self._store.dir.path).free,
            scans=counts["scans"],
        )

    def __enter__(self) -> Housekeeper:
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stop.set()
        self._thread.join()
