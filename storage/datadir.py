"""The data directory: what is where, whose it is, and who may write.

DIR/revisitd.json            uuid and format version of the directory
DIR/lock                     held by the writer (flock: a killed process lets go of it)
DIR/index.db                 scans, scenes, visits: can be rebuilt from the scan files
DIR/changes.db               what changed: precious
DIR/places.jsonl             sessions, scenes and visits once more, for that
DIR/sensors/<digest>.json    metadata of each sensor, as it gave it
DIR/scans/<session>/...      one file for each key scan
DIR/reserve                  space that is given back on a full disk
DIR/backups/changes-<UTC>.db copies of changes.db
"""

from __future__ import annotations

import fcntl
import json
import os
import time
import uuid
from pathlib import Path
from typing import IO

from .errors import DataDirBusy, DataDirError, NewerFormat
from .faults import naming
from .files import make_dir, write_atomically
from .filesystem import refuse_network

FORMAT = "revisitd data directory"
VERSION = 1


class DataDir:
    """An open data directory. Make one with `open_writer` or `open_reader`."""

    def __init__(self, path: Path, identity: str, lock: IO[str] | None):
        self.path = path
        self.uuid = identity
        self._lock = lock

    @classmethod
    def open_writer(cls, path: Path) -> DataDir:
        """Open for writing, made if it is not there. One writer at a time.

        Raises DataDirBusy, NewerFormat, DataDirError, StorageUnavailable, OSError (no permission).
        """
        path = Path(path)
        refuse_network(path)
        with naming(path):
            return cls._open_writer(path)

    @classmethod
    def _open_writer(cls, path: Path) -> DataDir:
        make_dir(path)
        lock = _take_lock(path)
        try:
            if not (path / "revisitd.json").exists():
                _refuse_strangers(path)
                _write_identity(path)
            identity = _read_identity(path)
            make_dir(path / "sensors")
            for leftover in (path / "sensors").glob("*.*.*"):  # half-written when a process was killed
                leftover.unlink()
        except BaseException:
            lock.close()
            raise
        return cls(path, identity, lock)

    @classmethod
    def open_reader(cls, path: Path) -> DataDir:
        """Open for reading, beside a writer or without one. Raises DataDirError, NewerFormat."""
        return cls(Path(path), _read_identity(Path(path)), None)

    def close(self) -> None:
        """Let the next writer in."""
        if self._lock is not None:
            self._lock.close()

    @property
    def index_path(self) -> Path:
        return self.path / "index.db"

    @property
    def changes_path(self) -> Path:
        return self.path / "changes.db"

    @property
    def places_path(self) -> Path:
        return self.path / "places.jsonl"

    @property
    def scans_path(self) -> Path:
        return self.path / "scans"

    @property
    def backups_path(self) -> Path:
        return self.path / "backups"

    def put_sensor(self, digest: str, metadata: str) -> None:
        """Keep a sensor's metadata JSON under its digest. The first text of a digest stays.

        Raises StorageUnavailable, OSError.
        """
        path = self._sensor_path(digest)
        if not path.exists():
            with naming(path):
                write_atomically(path, metadata.encode(), path.parent)

    def put_settings(self, text: str) -> None:
        """Keep the settings of the run that begins, for people: config.toml. Raises StorageUnavailable, OSError."""
        path = self.path / "config.toml"
        with naming(path):
            write_atomically(path, text.encode(), self.path / "sensors")

    def has_sensor(self, digest: str) -> bool:
        """Whether a sensor's metadata is kept."""
        return self._sensor_path(digest).exists()

    def get_sensor(self, digest: str) -> str:
        """A sensor's metadata JSON. Raises DataDirError."""
        path = self._sensor_path(digest)
        try:
            return path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise DataDirError(f"{path}: missing; without it the scans of this sensor have no geometry") from None

    def _sensor_path(self, digest: str) -> Path:
        return self.path / "sensors" / f"{digest}.json"


def _take_lock(path: Path) -> IO[str]:
    lock = open(path / "lock", "a+", encoding="utf-8")  # noqa: SIM115 - held as long as the directory is open
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        holder = lock.read().strip() or "unknown"
        lock.close()
        raise DataDirBusy(f"{path}: process {holder} writes here; stop it, or use another directory") from None
    lock.truncate(0)
    lock.write(f"{os.getpid()}\n")
    lock.flush()
    return lock


def _refuse_strangers(path: Path) -> None:
    """A directory that holds other things is likely a slip of the hand, or ours with its identity lost."""
    others = sorted(entry.name for entry in path.iterdir() if entry.name != "lock")
    others = [name for name in others if not name.startswith("revisitd.json")]  # left by a crash while being made
    if others:
        held = ", ".join(others[:3])
        raise DataDirError(f"{path}: not empty ({held}) and not a revisitd data directory; choose another")


def _write_identity(path: Path) -> None:
    identity = {"format": FORMAT, "version": VERSION, "uuid": str(uuid.uuid4()), "created_ns": time.time_ns()}
    write_atomically(path / "revisitd.json", (json.dumps(identity, indent=2) + "\n").encode(), path)


def _read_identity(path: Path) -> str:
    """The uuid of a directory whose format this program knows."""
    file = path / "revisitd.json"
    try:
        identity = json.loads(file.read_text(encoding="utf-8"))
        version, known = int(identity["version"]), identity["format"] == FORMAT
        name = str(uuid.UUID(str(identity["uuid"])))
    except (FileNotFoundError, NotADirectoryError):
        raise DataDirError(f"{path}: not a revisitd data directory (no revisitd.json)") from None
    except (ValueError, KeyError, TypeError) as error:
        raise DataDirError(f"{file}: damaged ({error}); restore it from a backup") from error
    if not known:
        raise DataDirError(f"{file}: of another program (format {identity['format']!r}); choose another directory")
    if version > VERSION:
        raise NewerFormat(f"{path}: format {version}, by a newer revisitd; this one knows {VERSION}: upgrade it")
    return name
