"""Compares what the data directory's parts say of each other, and mends it on demand. Nothing is ever deleted.

Checking may go on beside the writer; repairing needs the directory for itself.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from . import database
from .backup import backups, check_whole
from .database import suspicion
from .datadir import DataDir
from .errors import DatabaseFileError, DataDirError, ScanFileError
from .files import make_dir, sync_dir
from .rebuild import adopt
from .recovery import move_aside
from .retention import discard
from .scans import ScanStore
from .schema import CHANGES_MIGRATIONS, INDEX_MIGRATIONS
from .store import Store

Scan = tuple[int, int]  # session and scan id


@dataclass
class Findings:
    """What is wrong; empty lists where all is well."""

    databases: dict[Path, str] = field(default_factory=dict)  # damaged ones, and how
    unrelated: list[str] = field(default_factory=list)  # rows that refer to rows that are not there, by database
    garbage: list[Scan] = field(default_factory=list)  # deletions that a crash cut off
    missing: list[Scan] = field(default_factory=list)  # in the index, without a file
    unknown: list[Scan] = field(default_factory=list)  # whole files that the index does not know
    damaged: dict[Scan, str] = field(default_factory=dict)  # files, known or not, and how
    sensors: list[str] = field(default_factory=list)  # whose metadata is missing: their scans have no geometry
    backups: dict[Path, str] = field(default_factory=dict)  # damaged ones, and how
    counts: dict[str, int] = field(default_factory=dict)  # rows and files, for people

    def lines(self) -> list[str]:
        """One for each problem: what is wrong, and what repairing does about it."""
        return [
            *(f"{how}: moved aside, and made anew" for how in self.databases.values()),
            *(f"{what}: cannot be mended" for what in self.unrelated),
            *(f"{_name(scan)}: its deletion was cut off: finished" for scan in self.garbage),
            *(f"{_name(scan)}: in the index, but there is no file: taken out of the index" for scan in self.missing),
            *(f"{_name(scan)}: a whole file that the index does not know: entered" for scan in self.unknown),
            *(f"{how}: moved to damaged/, and out of the index" for how in self.damaged.values()),
            *(f"sensors/{sensor}.json: missing, no geometry: cannot be mended" for sensor in self.sensors),
            *(f"{how}: moved to damaged/" for how in self.backups.values()),
        ]


def check(path: Path) -> Findings:
    """Look at everything, and change nothing. Raises DataDirError, NewerFormat, StorageUnavailable."""
    data_dir = DataDir.open_reader(path)
    scans, findings = ScanStore(data_dir.scans_path), Findings()
    _check_databases(data_dir, findings)
    for backup in backups(data_dir):
        try:
            check_whole(backup)
        except DatabaseFileError as error:
            findings.backups[backup] = str(error)
    on_disk = list(scans.iter_ids())  # before the index is read: a scan's row is written after its file
    if data_dir.index_path not in findings.databases:
        _compare(data_dir, scans, on_disk, findings)
    for scan in on_disk:
        try:
            scans.read(*scan, images=False)
        except ScanFileError as error:
            if scans.path(*scan).exists():  # else it was deleted meanwhile
                findings.damaged[scan] = str(error)
    findings.unknown = [scan for scan in findings.unknown if scan not in findings.damaged]
    findings.counts["scan files"] = len(on_disk)
    return findings


def repair(path: Path) -> tuple[list[str], Findings]:
    """Mend what can be mended; what opening the databases did, and what is still wrong.

    Raises DataDirBusy beside a writer, and what check raises.
    """
    found = check(path)
    for database_path in found.databases:
        if database_path.exists():
            suspicion(database_path).touch()  # looked through when it is opened, however large
    if any("index.db" in what for what in found.unrelated):
        move_aside(path / "index.db")
    with Store.open_writer(path) as store:
        _put_aside(store.dir, list(found.backups))
        _put_aside(store.dir, [store.scans.path(*scan) for scan in found.damaged])
        discard(store.index.db, store.scans, [scan for scan in (*found.missing, *found.damaged)])
        known = set(store.index.db.tuples("SELECT session_id, scan_id FROM scans"))
        for scan in store.scans.iter_ids():
            if scan not in known:
                adopt(store.index, store.scans, *scan)
        return store.repairs, check(path)


def _check_databases(data_dir: DataDir, findings: Findings) -> None:
    for path, migrations in (
        (data_dir.index_path, INDEX_MIGRATIONS),
        (data_dir.changes_path, CHANGES_MIGRATIONS),
    ):
        try:
            with closing(database.open_reader(path, len(migrations))) as db:
                _check_database(db, path, data_dir.uuid, findings)
        except DatabaseFileError as error:
            findings.databases[path] = str(error)


def _check_database(db: database.Connection, path: Path, store_uuid: str, findings: Findings) -> None:
    problems = db.value("PRAGMA integrity_check(1)")
    if problems != "ok":
        findings.databases[path] = f"{path}: damaged: {problems.splitlines()[-1]}"
        return
    if db.value("SELECT uuid FROM store") != store_uuid:
        raise DataDirError(f"{path}: belongs to another data directory; put the right file back")
    for table, rowid, parent, _ in db.tuples("PRAGMA foreign_key_check"):
        findings.unrelated.append(f"{path}: row {rowid} of {table} refers to a row that is not in {parent}")


def _compare(data_dir: DataDir, scans: ScanStore, on_disk: list[Scan], findings: Findings) -> None:
    """The index with the files."""
    with closing(database.open_reader(data_dir.index_path, len(INDEX_MIGRATIONS))) as db:
        findings.garbage = db.tuples("SELECT session_id, scan_id FROM garbage ORDER BY scan_id")
        known = set(db.tuples("SELECT session_id, scan_id FROM scans"))
        digests = {digest for (digest,) in db.tuples("SELECT DISTINCT sensor_digest FROM sessions")}
        for table in ("sessions", "scans", "scenes", "visits"):
            findings.counts[table] = db.value(f"SELECT count(*) FROM {table}")
    files = set(on_disk)
    findings.missing = sorted(scan for scan in known - files if not scans.path(*scan).exists())
    findings.unknown = sorted(files - known - set(findings.garbage))
    findings.sensors = sorted(digest for digest in digests if not data_dir.has_sensor(digest))


def _put_aside(data_dir: DataDir, paths: list[Path]) -> None:
    folder = data_dir.path / "damaged"
    for path in paths:
        make_dir(folder)
        path.rename(folder / path.name)
        sync_dir(folder)


def _name(scan: Scan) -> str:
    return f"scan {scan[1]} of session {scan[0]}"
