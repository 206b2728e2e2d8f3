"""Errors of the operating system and of SQLite, told as the storage's own: which file, what, and what to do."""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import (
    DatabaseCorrupt,
    DatabaseFileError,
    StorageBusy,
    StorageError,
    StorageFull,
    StorageReadOnly,
    StorageUnavailable,
)

FULL = "no space left: free some, or lower storage.quota_gb"
READ_ONLY = "cannot be written: the file system, or the file, is read-only"
DAMAGED = "damaged: the next start of the daemon mends it"
FAILING = "the disk fails to read or write: see dmesg and smartctl"

_OF_SYSTEM: dict[int, tuple[type[StorageError], str]] = {
    errno.ENOSPC: (StorageFull, FULL),
    errno.EDQUOT: (StorageFull, FULL),
    errno.EROFS: (StorageReadOnly, READ_ONLY),
    errno.EIO: (StorageUnavailable, FAILING),
}
# By SQLite's own words, which have been the same since 2004: error codes come with Python 3.11 only.
_OF_SQLITE: tuple[tuple[str, type[StorageError], str], ...] = (
    ("database or disk is full", StorageFull, FULL),
    ("readonly database", StorageReadOnly, READ_ONLY),
    ("is locked", StorageBusy, "another program writes to it: end that, or let it commit"),
    ("disk I/O error", StorageUnavailable, FAILING),
    ("malformed", DatabaseCorrupt, DAMAGED),
    ("Could not decode", DatabaseCorrupt, DAMAGED),
    ("unsupported file format", DatabaseCorrupt, DAMAGED),
    ("not a database", DatabaseCorrupt, "not a database: the next start of the daemon mends it"),
)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Around an access to one file: what the system and SQLite raise names no file, or no remedy.

    Raises StorageError of the fitting kind. A violated constraint (sqlite3.IntegrityError) or a wrong use is the
    caller's own mistake and stays as it is, as does an OSError that is not of the disk (no permission, no such file).
    """
    try:
        yield
    except (sqlite3.IntegrityError, sqlite3.ProgrammingError):
        raise
    except sqlite3.DatabaseError as error:
        raise of_sqlite(path, error) from error
    except UnicodeDecodeError as error:  # SQLite names what it found damaged, and Python cannot read the name
        raise DatabaseCorrupt(f"{path}: {DAMAGED}") from error
    except OSError as error:
        if error.errno not in _OF_SYSTEM:
            raise
        kind, remedy = _OF_SYSTEM[error.errno]
        raise kind(f"{path}: {remedy}") from error


def of_sqlite(path: Path, error: sqlite3.DatabaseError) -> StorageError:
    """The storage's own error for one of SQLite's."""
    for words, kind, remedy in _OF_SQLITE:
        if words in str(error):
            return kind(f"{path}: {remedy}")
    return DatabaseFileError(f"{path}: {error}")
