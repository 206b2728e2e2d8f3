"""SQLite files as this program uses them: WAL, one writer, read-only readers, numbered migrations.

Thread rule: a writer's Connection may be used by any thread; every use takes its lock, so that a transaction of
one thread is never joined by another's statement. Readers open their own connection in each thread or process.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlite_utils

from .errors import DatabaseCorrupt, DatabaseFileError, DataDirError, NewerFormat, StorageError
from .faults import naming

Values = Sequence[Any] | Mapping[str, Any]  # for ? or for :name in a statement

logger = logging.getLogger(__name__)

OPENING_TIMEOUT_S = 5.0  # of a lock, while a database is opened
CHECK_BUDGET_S = 1.0  # a start must not wait longer for a file to be read through: the rest is noticed in use
CHECK_STEP = 10_000  # of SQLite's virtual machine, some ms, between two looks at the clock


class Connection:
    """One connection, with its lock.

    Every method raises the errors of faults.naming: StorageFull, StorageReadOnly, StorageBusy, DatabaseCorrupt, ...
    """

    def __init__(self, connection: sqlite3.Connection, path: Path, writes: bool):
        self._db = sqlite_utils.Database(connection)
        self._path, self._writes = path, writes
        self._lock = threading.RLock()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside becomes visible and durable at once, or not at all. May be nested."""
        with self._between("BEGIN IMMEDIATE"):
            yield

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """All queries inside see the same moment."""
        with self._between("BEGIN"):
            yield

    def write(self, sql: str, values: Values = ()) -> int:
        """Run one statement; the rowid of what it inserted. Durable at once unless in a transaction."""
        with self._using():
            return self._db.execute(sql, values).lastrowid

    def write_many(self, sql: str, rows: list[Sequence[Any]]) -> None:
        """Run one statement for each row, in one transaction."""
        with self.transaction(), self._using():
            self._db.conn.executemany(sql, rows)

    def insert(self, table: str, row: dict[str, Any]) -> int:
        """Insert a row by column names; its rowid."""
        marks = ", ".join("?" * len(row))
        return self.write(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))

    def rows(self, sql: str, values: Values = ()) -> list[dict[str, Any]]:
        """All rows of a query, as dictionaries."""
        with self._using():
            return list(self._db.query(sql, values))

    def tuples(self, sql: str, values: Values = ()) -> list[tuple[Any, ...]]:
        """All rows of a query, as tuples: for the large ones."""
        with self._using():
            return self._db.execute(sql, values).fetchall()

    def value(self, sql: str, values: Values = ()) -> Any:
        """The single value of a query that always has one."""
        with self._using():
            return self._db.execute(sql, values).fetchone()[0]

    @contextmanager
    def decoding(self) -> Iterator[None]:
        """Around the use of what was read: what this program never writes into a row is damage. Raises DatabaseCorrupt.

        Readers are not kept waiting for a check of the file when they open it.
        """
        try:
            yield
        except (TypeError, ValueError, OverflowError) as error:
            self._suspect()
            raise DatabaseCorrupt(f"{self._path}: damaged: a row holds what was never written: {error}") from error

    def attach(self, path: Path, name: str, n_migrations: int) -> None:
        """Read another database too, under a name; for readers. Raises DatabaseFileError, NewerFormat."""
        open_reader(path, n_migrations).close()
        with self._using():
            self._db.execute(f"ATTACH ? AS {name}", (_read_only_uri(path),))

    def close(self) -> None:
        """Close the file; a writer leaves all that was written in the file itself, and an empty WAL beside it.

        SQLite would delete -wal and -shm with the last connection, and a reader who may not write to the directory
        (another user's planner) could not open the file then. A read-only connection that closes last keeps them.
        """
        with self._lock:
            if not self._writes:
                self._db.close()
                return
            try:
                with naming(self._path):
                    self._db.execute("PRAGMA busy_timeout = 0")  # a reader at work: leave it the WAL as it is
                    self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                    with closing(_connect_read_only(self._path)) as keeper:
                        keeper.execute("PRAGMA user_version")
                        self._db.close()
            except StorageError as error:  # full, read-only, damaged: the WAL holds it all, the next start goes on
                logger.warning("closed without a checkpoint: %s", error)
            finally:
                self._db.close()

    @contextmanager
    def _between(self, begin: str) -> Iterator[None]:
        """In a transaction; in the outer one where there is one, which then commits."""
        with self._lock:
            if self._db.conn.in_transaction:
                yield
                return
            self._execute(begin)
            try:
                yield
                self._execute("COMMIT")
            except BaseException:
                if self._db.conn.in_transaction:
                    self._execute("ROLLBACK")
                raise

    def _execute(self, sql: str) -> None:
        with self._using():
            self._db.execute(sql)

    @contextmanager
    def _using(self) -> Iterator[None]:
        """Alone with the connection. Damage that a writer meets is noted, so that its next start looks closely."""
        with self._lock:
            try:
                with naming(self._path):
                    yield
            except DatabaseCorrupt:
                self._suspect()
                raise

    def _suspect(self) -> None:
        if self._writes:
            suspicion(self._path).touch()


def version(path: Path) -> int:
    """The schema's version; 0 where there is no file, or nothing in it. Raises DatabaseFileError."""
    if not path.exists():
        return 0
    with naming(path), closing(_connect_read_only(path)) as connection:
        return connection.execute("PRAGMA user_version").fetchone()[0]


def suspicion(path: Path) -> Path:
    """An empty file beside a database that was found damaged in use: it is read through at the next opening."""
    return path.with_name(f"{path.name}.suspect")


def open_writer(
    path: Path, migrations: Sequence[str], synchronous: str, busy_timeout_s: float, store_uuid: str
) -> Connection:
    """Open or make a database and bring it to the newest schema.

    migrations: SQL scripts; the n-th brings `PRAGMA user_version` from n - 1 to n. synchronous: NORMAL (a power cut
    may lose the last commits, never the file) or FULL (it loses none). busy_timeout_s: how long a write may wait
    for another program's lock. store_uuid ties the file to its data directory. Raises DatabaseCorrupt,
    DatabaseFileError, NewerFormat, DataDirError, StorageUnavailable.
    """
    with naming(path):
        connection = sqlite3.connect(path, OPENING_TIMEOUT_S, isolation_level=None, check_same_thread=False)
        try:
            _refuse_newer(connection, path, len(migrations))
            _check(connection, path, migrations)
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute(f"PRAGMA synchronous = {synchronous}")
            connection.execute("PRAGMA foreign_keys = ON")
            # A WAL of 1 MB, 4 MB at most after a time in which a reader held it: it counts towards the quota.
            connection.execute("PRAGMA wal_autocheckpoint = 250")
            connection.execute("PRAGMA journal_size_limit = 4000000")
            _migrate(connection, path, migrations)
            _tie(connection, path, store_uuid)
            connection.execute(f"PRAGMA busy_timeout = {round(busy_timeout_s * 1e3)}")
        except BaseException:
            connection.close()
            raise
    return Connection(connection, path, writes=True)


def open_reader(path: Path, n_migrations: int) -> Connection:
    """Open a database for reading only, beside its writer. Raises DatabaseFileError, NewerFormat."""
    if not Path(path).exists():
        raise DatabaseFileError(f"{path}: no such file")
    with naming(path):
        connection = _connect_read_only(path)
        try:
            if _refuse_newer(connection, path, n_migrations) < n_migrations:
                raise DatabaseFileError(f"{path}: not yet brought to this version's schema: start the writer once")
        except BaseException:
            connection.close()
            raise
    return Connection(connection, path, writes=False)


def _read_only_uri(path: Path) -> str:
    return f"file:{quote(str(Path(path).absolute()))}?mode=ro"


def _connect_read_only(path: Path) -> sqlite3.Connection:
    how = {"isolation_level": None, "check_same_thread": False, "uri": True}
    return sqlite3.connect(_read_only_uri(path), OPENING_TIMEOUT_S, **how)


def _check(connection: sqlite3.Connection, path: Path, migrations: Sequence[str]) -> None:
    """Read the file through, for a second at most, or wholly where damage was met in use. Raises DatabaseCorrupt."""
    applied = migrations[: connection.execute("PRAGMA user_version").fetchone()[0]]
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as fresh:
        fresh.executescript(";".join(applied))
        missing = _columns(fresh) - _columns(connection)
    if missing:
        raise DatabaseCorrupt(f"{path}: damaged: {' '.join(sorted(missing)[0])} is missing")
    doubt = suspicion(path)
    if doubt.exists():
        problems = connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
    else:
        problems = _quick_check(connection)
    if problems != "ok":
        raise DatabaseCorrupt(f"{path}: damaged: {problems.splitlines()[-1]}")
    doubt.unlink(missing_ok=True)


def _columns(connection: sqlite3.Connection) -> set[tuple[str, ...]]:
    """Names and types of all columns of all tables and views: SQLite's check of a file does not know them."""
    return set(
        connection.execute(
            "SELECT t.type, t.name, c.name, c.type FROM sqlite_schema AS t JOIN pragma_table_info(t.name) AS c"
        )
    )


def _quick_check(connection: sqlite3.Connection) -> str:
    """What quick_check finds in CHECK_BUDGET_S."""
    deadline = time.monotonic() + CHECK_BUDGET_S
    connection.set_progress_handler(lambda: time.monotonic() > deadline, CHECK_STEP)
    try:
        return connection.execute("PRAGMA quick_check(1)").fetchone()[0]
    except sqlite3.OperationalError as error:
        if "interrupted" not in str(error):
            raise
        return "ok"
    finally:
        connection.set_progress_handler(None, 0)


def _migrate(connection: sqlite3.Connection, path: Path, migrations: Sequence[str]) -> None:
    """Each missing migration and its number become visible together: a crash in between leaves neither."""
    version = _refuse_newer(connection, path, len(migrations))
    for number, script in enumerate(migrations[version:], start=version + 1):
        try:
            connection.executescript(f"BEGIN IMMEDIATE; {script}; PRAGMA user_version = {number}; COMMIT;")
        except sqlite3.Error:
            if connection.in_transaction:
                connection.execute("ROLLBACK")
            raise


def _refuse_newer(connection: sqlite3.Connection, path: Path, known: int) -> int:
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > known:
        raise NewerFormat(f"{path}: schema {version}, by a newer revisitd; this one knows up to {known}: upgrade it")
    return version


def _tie(connection: sqlite3.Connection, path: Path, store_uuid: str) -> None:
    """A database copied in from elsewhere would claim scans that are not here: notice it."""
    connection.execute(
        "INSERT INTO store (only_row, uuid, created_host_ns) VALUES (1, ?, ?) ON CONFLICT DO NOTHING",
        (store_uuid, time.time_ns()),
    )
    found = connection.execute("SELECT uuid FROM store").fetchone()[0]
    if found != store_uuid:
        raise DataDirError(
            f"{path}: belongs to data directory {found}, not to this one ({store_uuid}); put the right file back"
        )
