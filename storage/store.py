"""The whole data directory, opened at once: scans, index and changes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path

from .changes import ChangeStore
from .datadir import DataDir
from .errors import StorageError
from .index import IndexStore
from .placeslog import PlacesLog
from .recovery import open_changes, open_index
from .reserve import Reserve
from .retention import Retention, finish_garbage
from .scans import Scan, ScanStore

logger = logging.getLogger(__name__)


class Store:
    """An open data directory. A context manager; `close` may be called twice."""

    def __init__(self, data_dir: DataDir, scans: ScanStore, index: IndexStore, changes: ChangeStore, opened: ExitStack):
        """opened: closes all that was opened."""
        self.dir, self.scans, self.index, self.changes = data_dir, scans, index, changes
        self.repairs: list[str] = []  # what opening had to put right, for people
        self.grown = threading.Event()  # set by each scan, for whoever keeps the quota
        self._opened = opened

    @classmethod
    def open_writer(cls, path: Path) -> Store:
        """Open for writing, made if it is not there. A damaged or lost database is put right: see `repairs`.

        Raises DataDirBusy, DataDirError, NewerFormat, DatabaseFileError, StorageUnavailable, OSError (no permission).
        """
        repairs: list[str] = []
        Reserve(Path(path)).release_if_full()
        with ExitStack() as opened:
            data_dir = DataDir.open_writer(path)
            opened.callback(data_dir.close)
            scans = ScanStore(data_dir.scans_path)
            scans.prepare()
            index = open_index(data_dir, scans, repairs)
            opened.callback(index.close)
            changes = open_changes(data_dir, repairs)
            opened.callback(changes.close)
            store = cls(data_dir, scans, index, changes, opened.pop_all())
        store.repairs = repairs
        store._next_scan_id = max(index.next_scan_id(), scans.highest_id() + 1)
        store._places_log = PlacesLog(data_dir.places_path, index.db)
        store._opened.callback(_if_possible, store.log_places)
        _if_possible(store.log_places)
        _if_possible(lambda: finish_garbage(index.db, scans))
        return store

    @classmethod
    def open_reader(cls, path: Path) -> Store:
        """Open for reading, beside a writer or without one. Raises DataDirError, NewerFormat, DatabaseFileError."""
        data_dir = DataDir.open_reader(path)
        with ExitStack() as opened:
            index = IndexStore.open_reader(data_dir.index_path)
            opened.callback(index.close)
            changes = ChangeStore.open_reader(data_dir.changes_path)
            opened.callback(changes.close)
            return cls(data_dir, ScanStore(data_dir.scans_path), index, changes, opened.pop_all())

    def new_scan_id(self) -> int:
        """An id that no scan has had before, higher than all."""
        scan_id = self._next_scan_id
        self._next_scan_id += 1
        return scan_id

    def add_scan(self, scan: Scan, visit_ids: Iterable[int] = ()) -> None:
        """Store a key scan: first its file, then its row with its place in the visits. A crash in between
        leaves a file that the index does not know; nothing is ever in the index without its file.

        Raises StorageUnavailable (disk full, read-only, index locked) with nothing stored.
        """
        n_bytes = self.scans.write(scan)
        try:
            with self.index.transaction():
                self.index.add_scan(scan, n_bytes)
                for visit_id in visit_ids:
                    self.index.add_visit_scans(visit_id, [scan.scan_id])
        except BaseException:
            self.scans.delete([(scan.session, scan.scan_id)])
            raise
        self.grown.set()

    def log_places(self) -> None:
        """Note new sessions, scenes and visits where a lost index is rebuilt from; by one thread at a time.

        Raises StorageUnavailable, DatabaseCorrupt, OSError; the next call makes up for it, also after a restart.
        """
        self._places_log.catch_up()

    def retention(self, *, quota_bytes: int, min_free_bytes: int, kept_per_visit: int, recent_ns: int) -> Retention:
        """What keeps this directory within its quota, step by step: see retention.py."""
        limits = {"quota_bytes": quota_bytes, "min_free_bytes": min_free_bytes}
        kept = {"kept_per_visit": kept_per_visit, "recent_ns": recent_ns}
        return Retention(self.dir, self.scans, self.index.db, **limits, **kept)

    def close(self) -> None:
        self._opened.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


def _if_possible(task: Callable[[], object]) -> None:
    """Do what may be done later: a store that opens, or closes, is worth more."""
    try:
        task()
    except StorageError as error:
        logger.warning("put off: %s", error)
