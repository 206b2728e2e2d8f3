"""Keeps the data directory within its quota, and the disk from filling up: the least useful scans are deleted.

A scan goes in an order that a crash may cut anywhere: its rows become a garbage row, its file is unlinked, the garbage
row is deleted; the next start finishes what is left. What the index does not know is never deleted.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from . import database
from .datadir import DataDir
from .errors import StorageFull
from .faults import naming
from .reserve import Reserve
from .scans import ScanStore
from .usefulness import Tier, Victim, least_useful

logger = logging.getLogger(__name__)

BLOCK_BYTES = 4096  # a file takes whole blocks
# Deletion begins at HIGH and ends at LOW: together, so that folders are synced and plans are made once for many.
HIGH, LOW = 0.99, 0.98  # of the quota
SCANS_PER_STEP = 50  # some 10 ms
SCANS_PER_PLAN = 500
PLAN_S = 300.0  # what was least useful some minutes ago may be evidence now


@dataclass(frozen=True)
class RetentionReport:
    """How full it is, and what one step did."""

    used_bytes: int  # of the data directory, in whole blocks, before the step
    free_bytes: int  # of its file system
    n_deleted: int
    more: bool  # still too full, and there are scans that may go: call again soon
    problem: str  # why it stays too full, or what had to go that is needed; empty where all is well


class Retention:
    """Called step by step by one housekeeping thread, beside the writer."""

    def __init__(
        self,
        data_dir: DataDir,
        scans: ScanStore,
        index: database.Connection,
        *,
        quota_bytes: int,
        min_free_bytes: int,
        kept_per_visit: int,
        recent_ns: int,
    ):
        """quota_bytes: for the whole directory. min_free_bytes: what is to stay free on its file system.

        kept_per_visit, recent_ns: see usefulness.least_useful.
        """
        self._dir, self._scans, self._index = data_dir, scans, index
        self._quota_bytes, self._min_free_bytes = quota_bytes, min_free_bytes
        self._kept_per_visit, self._recent_ns = kept_per_visit, recent_ns
        self._reserve = Reserve(data_dir.path)
        self._plan: list[Victim] = []  # the next to go last
        self._plan_until_s = 0.0
        self._deleting = False  # between HIGH and LOW

    def step(self) -> RetentionReport:
        """Delete some scans if it is too full. Raises StorageUnavailable, DatabaseFileError, OSError."""
        used = used_bytes(self._dir.path, self._index)
        free = free_bytes(self._dir.path)
        over_quota = used - self._quota_bytes * (LOW if self._deleting else HIGH)
        too_little_free = self._min_free_bytes - free
        self._deleting = over_quota > 0
        victims, problem = [], ""
        if over_quota > 0:
            victims = self._take(over_quota, Tier.RECENT)
            if not victims:
                problem = f"{used / 1e9:.2f} GB are used without any scans: raise storage.quota_gb"
            elif victims[-1].tier >= Tier.REFERENCE:
                problem = "scans that are needed are deleted: raise storage.quota_gb"
        elif too_little_free > 0:
            # Others may have filled the disk: for their sake the places must not be forgotten.
            victims = self._take(too_little_free, Tier.EVIDENCE)
            if not victims:
                problem = f"{free / 1e9:.2f} GB are free and no scan may go: free some, or lower storage.min_free_gb"
        if victims:
            self._discard([(victim.session, victim.scan_id) for victim in victims])
        else:
            with naming(self._dir.path):
                self._reserve.hold()
        return RetentionReport(used, free, len(victims), bool(victims), problem)

    def _discard(self, ids: list[tuple[int, int]]) -> None:
        try:
            discard(self._index, self._scans, ids)
        except StorageFull:
            if not self._reserve.release():
                raise
            discard(self._index, self._scans, ids)

    def _take(self, excess_bytes: float, highest: Tier) -> list[Victim]:
        """The next victims, until they make up for the excess."""
        if not self._plan or time.monotonic() > self._plan_until_s:
            self._plan = least_useful(self._dir, SCANS_PER_PLAN, self._kept_per_visit, self._recent_ns)[::-1]
            self._plan_until_s = time.monotonic() + PLAN_S
        taken: list[Victim] = []
        while self._plan and self._plan[-1].tier <= highest and len(taken) < SCANS_PER_STEP and excess_bytes > 0:
            taken.append(self._plan.pop())
            excess_bytes -= taken[-1].bytes
        return taken


def discard(index: database.Connection, scans: ScanStore, ids: list[tuple[int, int]]) -> None:
    """Delete scans (session, scan_id): their rows, descriptors and places in visits, then their files."""
    with index.transaction():
        index.write_many("INSERT INTO garbage (session_id, scan_id) VALUES (?, ?)", ids)
        index.write_many("DELETE FROM scans WHERE session_id = ? AND scan_id = ?", ids)
    finish_garbage(index, scans)


def finish_garbage(index: database.Connection, scans: ScanStore) -> int:
    """Delete the files of all garbage rows, then the rows; how many. Also for what a crash left."""
    garbage = index.tuples("SELECT session_id, scan_id FROM garbage")
    if garbage:
        scans.delete(garbage)
        index.write_many("DELETE FROM garbage WHERE session_id = ? AND scan_id = ?", garbage)
    return len(garbage)


def used_bytes(directory: Path, index: database.Connection) -> int:
    """What a data directory takes on disk: the scan files by the index, all else by its size, in whole blocks."""
    used = index.value("SELECT scan_bytes FROM usage")
    for folder, subfolders, names in os.walk(directory):
        if folder == str(directory):
            subfolders.remove("scans")
        for name in names:
            with suppress(FileNotFoundError):  # a WAL may go in this moment
                used += blocks_bytes(os.stat(os.path.join(folder, name)).st_size)
    return used


def blocks_bytes(size: int) -> int:
    """What a file of this size takes on disk."""
    return -(-size // BLOCK_BYTES) * BLOCK_BYTES


def free_bytes(directory: Path) -> int:
    """What is free for this user on the directory's file system. Raises StorageUnavailable, OSError."""
    with naming(directory):
        return shutil.disk_usage(directory).free
