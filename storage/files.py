"""Files that are there whole or not at all, also after a power cut."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: Path, data: bytes, temporary_dir: Path) -> None:
    """Write data to path so that a reader, or a crash, finds the old file or the new one.

    temporary_dir lies on the same file system; what a crash leaves there may be deleted at the next start.
    Raises OSError (disk full, read-only).
    """
    temporary = temporary_dir / f"{path.name}.{os.getpid()}"
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_dir(path.parent)


def replace_durably(source: Path, path: Path) -> None:
    """Give a finished file its place, on the same file system, whole also after a power cut."""
    with open(source, "rb") as file:
        os.fsync(file.fileno())
    os.replace(source, path)
    sync_dir(path.parent)


def make_dir(path: Path) -> None:
    """Create a directory, with those above it, so that it outlives a power cut."""
    if path.is_dir():
        return
    make_dir(path.parent)
    path.mkdir(exist_ok=True)
    sync_dir(path.parent)


def sync_dir(path: Path) -> None:
    """Make the names in a directory durable: fsync of a file alone does not."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
