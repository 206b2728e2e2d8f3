"""Makes a lost index.db anew, from places.jsonl and the scan files."""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import placeslog
from .datadir import DataDir
from .errors import ScanFileError
from .files import replace_durably
from .index import IndexStore
from .rows import InstanceRow
from .scans import Scan, ScanStore

logger = logging.getLogger(__name__)

SCANS_PER_TRANSACTION = 1000
UNKNOWN = "unknown"  # of a session of which only scan files are left


def rebuild_index(data_dir: DataDir, scans: ScanStore) -> str:
    """Make index.db anew, whole or not at all; what could be rebuilt and what could not, for people.

    Raises StorageUnavailable, OSError.
    """
    part = data_dir.index_path.with_name("index.db.part")
    _remove(part)  # of a killed process
    index = IndexStore.open_writer(part, data_dir.uuid)
    try:
        _add_places(index, data_dir.places_path)
        n_scans, n_damaged = _add_scans(index, scans)
        _add_visit_scans(index, data_dir.places_path)
        _end_sessions(index)
        _settle_visits(index)
        counts = index.counts()
    finally:
        index.close()
    for suffix in ("-wal", "-shm"):
        part.with_name(part.name + suffix).unlink(missing_ok=True)
    replace_durably(part, data_dir.index_path)
    return (
        f"rebuilt with {counts['sessions']} sessions, {n_scans} scans, {counts['scenes']} scenes, {counts['visits']} "
        f"visits; lost: the records of detection instances, and {n_damaged} scans whose files are damaged"
    )


def adopt(index: IndexStore, scans: ScanStore, session: int, scan_id: int) -> None:
    """Enter a scan file that the index does not know. Raises ScanFileError."""
    scan = scans.read(session, scan_id, images=False)
    with index.transaction():
        if not index.db.tuples("SELECT 1 FROM sessions WHERE session_id = ?", (session,)):
            _insert(index, "sessions", _unknown_session(scan))
        index.add_scan(scan, scans.path(session, scan_id).stat().st_size)


def _add_places(index: IndexStore, path: Path) -> None:
    for line in placeslog.read(path):
        for table in ("sessions", "scenes", "visits"):
            for row in getattr(line, table):
                _insert(index, table, row)


def _add_scans(index: IndexStore, scans: ScanStore) -> tuple[int, int]:
    """How many were added, and how many are damaged."""
    ids = list(scans.iter_ids())
    n_damaged = 0
    for start in range(0, len(ids), SCANS_PER_TRANSACTION):
        with index.transaction():
            for session, scan_id in ids[start : start + SCANS_PER_TRANSACTION]:
                try:
                    adopt(index, scans, session, scan_id)
                except ScanFileError as error:
                    n_damaged += 1
                    logger.error("not in the rebuilt index: %s", error)
        logger.info("rebuilding the index: %d of %d scans", min(start + SCANS_PER_TRANSACTION, len(ids)), len(ids))
    return len(ids) - n_damaged, n_damaged


def _add_visit_scans(index: IndexStore, path: Path) -> None:
    """Those whose visits and scans are there."""
    for line in placeslog.read(path):
        index.db.write_many(
            """INSERT OR IGNORE INTO visit_scans
               SELECT visit_id, scan_id FROM visits CROSS JOIN scans WHERE visit_id = ? AND scan_id = ?""",
            [(visit.visit_id, scan_id) for visit in line.visit_scans for scan_id in visit.scan_ids],
        )


def _end_sessions(index: IndexStore) -> None:
    """They have all ended, at their last scan as far as is known."""
    index.db.write(
        """UPDATE sessions SET ended_host_ns = coalesce(
               (SELECT max(host_ns) FROM scans WHERE scans.session_id = sessions.session_id), started_host_ns)"""
    )


def _settle_visits(index: IndexStore) -> None:
    """Not known to have been compared, but not due either: most were, and would be found again."""
    for scene_id, visit_id in index.db.tuples("SELECT scene_id, visit_id FROM visits WHERE number >= 2"):
        index.record_instance(InstanceRow(scene_id, visit_id, "dropped", "the index was rebuilt: not known"))


def _unknown_session(scan: Scan) -> dict[str, Any]:
    """In a map of its own: whether it had joined an earlier one is not known."""
    texts = ("source", "serial", "product", "firmware", "profile", "clock_source", "config", "software_version")
    return {
        "session_id": scan.session,
        "map_id": scan.session,
        "started_host_ns": scan.host_ns,
        "sensor_digest": scan.sensor_digest,
        **dict.fromkeys(texts, UNKNOWN),
    }


def _insert(index: IndexStore, table: str, row: Mapping[str, Any]) -> None:
    """Insert a row that may be there already. One that the schema refuses, as none was ever written, is left out."""
    columns = {name for (name,) in index.db.tuples("SELECT name FROM pragma_table_info(?)", (table,))}
    row = {name: value for name, value in row.items() if name in columns}
    marks = ", ".join("?" * len(row))
    sql = f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks}) ON CONFLICT DO NOTHING"
    try:
        index.db.write(sql, tuple(row.values()))
    except sqlite3.IntegrityError as error:
        logger.error("not in the rebuilt index: a row of %s: %s", table, error)


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
