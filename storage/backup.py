"""Backups of changes.db: DIR/backups/changes-<UTC>.db, whole, checked, the newest few kept."""

from __future__ import annotations

import logging
import time
from contextlib import closing
from datetime import datetime, timezone
from pathlib import Path

from . import database
from .datadir import DataDir
from .errors import DatabaseCorrupt, DatabaseFileError, NewerFormat
from .files import make_dir, replace_durably
from .schema import CHANGES_MIGRATIONS

logger = logging.getLogger(__name__)

PATTERN = "changes-*.db"
NAME = "changes-%Y%m%dT%H%M%SZ.db"  # sorts by time


def back_up_if_due(data_dir: DataDir, interval_s: float, kept: int) -> Path | None:
    """Back changes.db up if it holds anything new since the newest backup, and that is older than this; keep `kept`.

    None where it is not due: the first is due with the first change. Raises StorageUnavailable, DatabaseCorrupt: older
    backups stay then.
    """
    existing = backups(data_dir)
    # A clock that was set back makes the newest backup look to be of the future: age counts either way.
    if existing and abs(time.time() - existing[-1].stat().st_mtime) < interval_s:
        return None
    if _revision(data_dir.changes_path) == (_revision(existing[-1]) if existing else 0):
        return None
    made = _back_up(data_dir)
    for old in backups(data_dir)[:-kept]:
        old.unlink()
    logger.info("backed up path=%s bytes=%d", made, made.stat().st_size)
    return made


def backups(data_dir: DataDir) -> list[Path]:
    """All finished backups, oldest first."""
    return sorted(data_dir.backups_path.glob(PATTERN))


def _revision(path: Path) -> int | None:
    """The last revision of a changes.db; None where it does not say."""
    try:
        with closing(database.open_reader(path, len(CHANGES_MIGRATIONS))) as db:
            return db.value("SELECT last_revision FROM store")
    except (DatabaseFileError, NewerFormat):
        return None


def _back_up(data_dir: DataDir) -> Path:
    """Write a backup, check it, and only then give it its name: an older good one is never lost to a bad one."""
    folder = data_dir.backups_path
    make_dir(folder)
    for leftover in folder.glob("*.part"):  # of a killed process
        leftover.unlink()
    path = folder / datetime.now(timezone.utc).strftime(NAME)
    part = path.with_suffix(".part")
    with closing(database.open_reader(data_dir.changes_path, len(CHANGES_MIGRATIONS))) as db:
        db.write("VACUUM INTO ?", (str(part),))
    check_whole(part)
    replace_durably(part, path)
    return path


def check_whole(path: Path) -> None:
    """Read a changes.db through. Raises DatabaseCorrupt, DatabaseFileError, NewerFormat."""
    with closing(database.open_reader(path, len(CHANGES_MIGRATIONS))) as db:
        problems = db.value("PRAGMA quick_check(1)")
    if problems != "ok":
        raise DatabaseCorrupt(f"{path}: damaged: {problems.splitlines()[-1]}")
