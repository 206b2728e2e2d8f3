"""Opens the two databases for writing, and puts good ones in the place of damaged or lost ones.

What is damaged is moved aside as <name>.corrupt-<UTC>, never deleted. The index is rebuilt from the scan files;
changes.db comes back from its newest good backup.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from typing import TypeVar

from . import database
from .backup import backups, check_whole
from .changes import ChangeStore
from .datadir import DataDir
from .errors import DatabaseCorrupt, DatabaseFileError
from .files import replace_durably, sync_dir
from .index import IndexStore
from .rebuild import rebuild_index
from .scans import ScanStore

Opened = TypeVar("Opened", IndexStore, ChangeStore)

logger = logging.getLogger(__name__)


def open_index(data_dir: DataDir, scans: ScanStore, repairs: list[str]) -> IndexStore:
    """Open or make index.db; rebuilt where it is damaged, or gone though there are scans. Repairs are noted.

    Raises NewerFormat, DataDirError, DatabaseFileError, StorageUnavailable.
    """
    path = data_dir.index_path
    try:
        if database.version(path) or not (data_dir.places_path.exists() or scans.highest_id()):
            return _sound(path, lambda: IndexStore.open_writer(path, data_dir.uuid))
        fault = f"{path} was lost"
    except DatabaseCorrupt as error:
        logger.error("%s", error)
        fault = f"{path} was damaged"
    kept = move_aside(path)
    _note(repairs, f"{fault}; {kept}{rebuild_index(data_dir, scans)}")
    return IndexStore.open_writer(path, data_dir.uuid)


def open_changes(data_dir: DataDir, repairs: list[str]) -> ChangeStore:
    """Open or make changes.db; restored where it is damaged, or gone though there are backups. Repairs are noted.

    Raises NewerFormat, DataDirError, DatabaseFileError, StorageUnavailable.
    """
    path = data_dir.changes_path
    try:
        if database.version(path) or not backups(data_dir):
            return _sound(path, lambda: ChangeStore.open_writer(path, data_dir.uuid))
        fault = f"{path} was lost"
    except DatabaseCorrupt as error:
        logger.error("%s", error)
        fault = f"{path} was damaged"
    kept = move_aside(path)
    restored = _restore(data_dir)
    store = ChangeStore.open_writer(path, data_dir.uuid)
    store.skip_used_numbers()
    came = f"restored from {restored.name}: changes since then are lost" if restored else "no good backup: all are lost"
    _note(repairs, f"{fault}; {kept}{came}")
    return store


def _sound(path: Path, open_writer: Callable[[], Opened]) -> Opened:
    """An opened database; where damage was met in use, only after every row was read. Raises DatabaseCorrupt.

    SQLite has no checksums: damage within a row is not noticed by its checks.
    """
    doubted = database.suspicion(path).exists()
    store = open_writer()
    if doubted:
        try:
            store.read_through()
        except BaseException:
            store.close()
            raise
    return store


def _note(repairs: list[str], what: str) -> None:
    logger.error("%s", what)
    repairs.append(what)


def move_aside(path: Path) -> str:
    """Keep a damaged database, with its WAL, under another name; the words for that, empty where there is none."""
    if not path.exists():
        return ""
    kept = path.with_name(f"{path.name}.corrupt-{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}")
    for suffix in ("-wal", "-shm", ""):  # the file itself last: a crash in between finds it damaged again
        part = path.with_name(path.name + suffix)
        if part.exists():
            part.rename(kept.with_name(kept.name + suffix))
    database.suspicion(path).unlink(missing_ok=True)
    sync_dir(path.parent)
    return f"kept as {kept.name}; "


def _restore(data_dir: DataDir) -> Path | None:
    """Put the newest good backup in the place of changes.db; which one."""
    for backup in reversed(backups(data_dir)):
        try:
            check_whole(backup)
        except DatabaseFileError as error:
            logger.error("not restored: %s", error)
            continue
        part = data_dir.changes_path.with_name("changes.db.part")
        shutil.copyfile(backup, part)
        replace_durably(part, data_dir.changes_path)
        return backup
    return None
