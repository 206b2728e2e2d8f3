"""places.jsonl: sessions, scenes and visits once more, from which a lost index.db is rebuilt beside the scan files.

A scan file is written before it is known which visits its scan will be part of: they cannot be in it. Each line is
the CRC-32 of its JSON in hex, a space, and the JSON: rows of the index's tables by their column names (a visit with
its "scan_ids"), and "up_to", the highest ids written so far. Lines are only ever appended.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from . import database
from .faults import naming
from .files import sync_dir

ROWS_PER_LINE = 100  # a torn line costs no more than these
# Visits are written once, when they have ended; later ones wait for an open one, so that ids grow from line to line.
TABLES = {
    "sessions": "SELECT * FROM sessions WHERE session_id > ? ORDER BY session_id LIMIT ?",
    "scenes": "SELECT * FROM scenes WHERE scene_id > ? ORDER BY scene_id LIMIT ?",
    "visits": """
        SELECT *, (SELECT json_group_array(scan_id) FROM visit_scans AS vs WHERE vs.visit_id = v.visit_id) AS scan_ids
        FROM visits AS v
        WHERE visit_id > ? AND visit_id < coalesce((SELECT min(visit_id) FROM visits WHERE t_out_ns IS NULL), 1 << 62)
        ORDER BY visit_id LIMIT ?""",
}
KEYS = {"sessions": "session_id", "scenes": "scene_id", "visits": "visit_id"}


class PlacesLog:
    """The writer's end. Used by one thread at a time."""

    def __init__(self, path: Path, index: database.Connection):
        self._path, self._index = path, index
        lines = list(read(path))
        self._up_to = lines[-1]["up_to"] if lines else dict.fromkeys(TABLES, 0)

    def catch_up(self) -> None:
        """Append what the index holds and the file does not. Raises StorageUnavailable, OSError: then the next
        call does it."""
        while batch := self._missing():
            up_to = {**self._up_to, **{table: rows[-1][KEYS[table]] for table, rows in batch.items()}}
            with naming(self._path):
                _append(self._path, {**batch, "up_to": up_to})
            self._up_to = up_to

    def _missing(self) -> dict[str, list[dict[str, Any]]]:
        found = {table: self._index.rows(sql, (self._up_to[table], ROWS_PER_LINE)) for table, sql in TABLES.items()}
        for visit in found["visits"]:
            visit["scan_ids"] = json.loads(visit["scan_ids"])
        return {table: rows for table, rows in found.items() if rows}


def read(path: Path) -> Iterator[dict[str, Any]]:
    """The lines that are whole; none where there is no file. A torn or damaged one is passed over."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        for line in file:
            checksum, _, text = line.rstrip(b"\n").partition(b" ")
            if checksum == b"%08x" % zlib.crc32(text):
                yield json.loads(text)


def _append(path: Path, content: dict[str, Any]) -> None:
    """One durable line. What a crash left of a line before it is ended first."""
    text = json.dumps(content, separators=(",", ":")).encode()
    is_new = not path.exists()
    with open(path, "ab+", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size and os.pread(file.fileno(), 1, size - 1) != b"\n":
            file.write(b"\n")
        file.write(b"%08x %s\n" % (zlib.crc32(text), text))
        os.fsync(file.fileno())
    if is_new:
        sync_dir(path.parent)
