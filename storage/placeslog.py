"""places.jsonl: sessions, scenes and visits once more, from which a lost index.db is rebuilt beside the scan files.

A scan file is written before it is known which visits its scan will be part of: they cannot be in it. Each line is the
CRC-32 of its JSON in hex, a space, and the JSON, a Line. Lines are only ever appended.
"""

from __future__ import annotations

import logging
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from . import database
from .faults import naming
from .files import sync_dir

logger = logging.getLogger(__name__)

ROWS_PER_LINE = 100  # a torn line costs no more than these
TAIL_BYTES = 4_000_000  # hold several lines; without a whole one in them all is noted once more, and does no harm
Id = Annotated[int, Field(ge=0, lt=1 << 63)]
Row = dict[str, Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)] | float | str | None]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True)


class UpTo(_Part):
    """The highest ids that are in the file."""

    sessions: Id = 0
    scenes: Id = 0
    visits: Id = 0


class VisitScans(_Part):
    """Which scans a visit consists of."""

    visit_id: Id
    scan_ids: list[Id]


class Line(_Part):
    """Rows of the index by column names, in tables of which each refers to those before it."""

    sessions: list[Row]
    scenes: list[Row]
    visits: list[Row]
    visit_scans: list[VisitScans]
    up_to: UpTo


class PlacesLog:
    """The writer's end. Used by one thread at a time."""

    def __init__(self, path: Path, index: database.Connection):
        self._path, self._index = path, index
        last = _last_line(path)
        self._up_to = last.up_to if last else UpTo()

    def catch_up(self) -> None:
        """Append what the index holds and the file does not. Raises StorageUnavailable, OSError: then the next
        call does it."""
        while (line := self._next_line()).up_to != self._up_to:
            with naming(self._path):
                _append(self._path, line)
            self._up_to = line.up_to

    def _next_line(self) -> Line:
        up_to = self._up_to
        sessions = self._index.rows(
            "SELECT * FROM sessions WHERE session_id > ? ORDER BY session_id LIMIT ?", (up_to.sessions, ROWS_PER_LINE)
        )
        scenes = self._index.rows(
            "SELECT * FROM scenes WHERE scene_id > ? ORDER BY scene_id LIMIT ?", (up_to.scenes, ROWS_PER_LINE)
        )
        # Once each, when they have ended; later ones wait for an open one, so that ids grow from line to line.
        visits = self._index.rows(
            """SELECT * FROM visits WHERE visit_id > ?
                   AND visit_id < coalesce((SELECT min(visit_id) FROM visits WHERE t_out_ns IS NULL), 1 << 62)
               ORDER BY visit_id LIMIT ?""",
            (up_to.visits, ROWS_PER_LINE),
        )
        return Line(
            sessions=sessions,
            scenes=scenes,
            visits=visits,
            visit_scans=[self._visit_scans(visit["visit_id"]) for visit in visits],
            up_to=UpTo(
                sessions=sessions[-1]["session_id"] if sessions else up_to.sessions,
                scenes=scenes[-1]["scene_id"] if scenes else up_to.scenes,
                visits=visits[-1]["visit_id"] if visits else up_to.visits,
            ),
        )

    def _visit_scans(self, visit_id: int) -> VisitScans:
        rows = self._index.tuples("SELECT scan_id FROM visit_scans WHERE visit_id = ?", (visit_id,))
        return VisitScans(visit_id=visit_id, scan_ids=[row[0] for row in rows])


def read(path: Path) -> Iterator[Line]:
    """The lines that are whole; none where there is no file. A torn or damaged one is passed over."""
    if not path.exists():
        return
    with open(path, "rb") as file:
        for text in file:
            line = _whole_line(text)
            if line is not None:
                yield line


def _last_line(path: Path) -> Line | None:
    """The last whole line, without reading years of them."""
    if not path.exists():
        return None
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - TAIL_BYTES))
        texts = file.read().splitlines()
    return next((line for text in reversed(texts) if (line := _whole_line(text)) is not None), None)


def _whole_line(text: bytes) -> Line | None:
    checksum, _, content = text.rstrip(b"\n").partition(b" ")
    if checksum != b"%08x" % zlib.crc32(content):
        return None
    try:
        return Line.model_validate_json(content)
    except ValidationError as error:
        logger.error("a line of places.jsonl is not laid out as it should be: %d errors", error.error_count())
        return None


def _append(path: Path, line: Line) -> None:
    """One durable line. What a crash left of a line before it is ended first."""
    text = line.model_dump_json().encode()
    is_new = not path.exists()
    with open(path, "ab+", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        if size and os.pread(file.fileno(), 1, size - 1) != b"\n":
            file.write(b"\n")
        file.write(b"%08x %s\n" % (zlib.crc32(text), text))
        os.fsync(file.fileno())
    if is_new:
        sync_dir(path.parent)
