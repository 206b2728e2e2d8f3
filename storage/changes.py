"""changes.db: the objects that appeared and disappeared. Precious, and the contract with other programs.

Synchronous FULL: what was acknowledged outlives a power cut. Tables and views are described in schema.py; other
programs may read them with any SQLite (open with `mode=ro`), or through ChangeStore.open_reader.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from . import database
from .changerows import (
    OTHER_COLUMNS,
    Change,
    ChangeObject,
    MergedChange,
    Observation,
    change_object,
    one_per_voxel,
    point_columns,
)
from .errors import StorageError
from .schema import CHANGES_MIGRATIONS

BUSY_TIMEOUT_S = 5.0  # the detection thread writes here, and tries again


class ChangeStore:
    """The open changes. Thread rule: any thread may call any method; one connection behind one lock."""

    def __init__(self, connection: database.Connection):
        self._db = connection

    @classmethod
    def open_writer(cls, path: Path, store_uuid: str) -> ChangeStore:
        """Open or make. Raises DatabaseFileError, NewerFormat, DataDirError."""
        return cls(database.open_writer(path, CHANGES_MIGRATIONS, "FULL", BUSY_TIMEOUT_S, store_uuid))

    @classmethod
    def open_reader(cls, path: Path) -> ChangeStore:
        """Open read-only, beside the writer. Raises DatabaseFileError, NewerFormat."""
        return cls(database.open_reader(path, len(CHANGES_MIGRATIONS)))

    def read_through(self) -> None:
        """Read every row as the program does. Raises DatabaseCorrupt."""
        for change in self.changes():
            self.history(change.id)

    def close(self) -> None:
        self._db.close()

    # Writing ------------------------------------------------------------------------------------------------------

    def add(self, change: Change) -> int:
        """Store a new change, durably; its id. Raises StorageError where it has no points."""
        now_ns = time.time_ns()
        row = {
            "polarity": change.polarity,
            "map_id": change.map_id,
            "session_id": change.session,
            "scene_id": change.scene,
            "visit": change.visit,
            "first_seen_ns": change.first_seen_ns,
            "first_seen_host_ns": change.first_seen_host_ns,
            "last_before_session": change.last_before_session,
            "last_before_ns": change.last_before_ns,
            **point_columns(one_per_voxel(change.points)),
            "confidence": change.confidence,
            "evidence": json.dumps(dict(change.evidence)),
            "alignment_residual_m": change.alignment_residual_m,
            "model_id": change.model_id,
            "config_digest": change.config_digest,
            "detected_host_ns": now_ns,
            "updated_host_ns": now_ns,
        }
        with self._db.transaction():
            change_id = self._db.insert("changes", {**row, "revision": self._next_revision()})
            found = Observation(change.polarity, change.session, change.scene, change.visit, change.first_seen_ns)
            self._note(change_id, found)
        return change_id

    def extend(self, change_id: int, points: np.ndarray, confidence: float, evidence: Mapping[str, Any]) -> None:
        """Add points (N, 3) of the same object, metres, map frame; those already there stay as they are.

        confidence and evidence replace what was known. Raises StorageError where there is no such change.
        """
        with self._db.transaction():
            old = self.get(change_id)
            merged = one_per_voxel(np.concatenate([old.points, np.asarray(points, np.float32)]))
            values = {
                **point_columns(merged),
                "confidence": confidence,
                "evidence": json.dumps(dict(evidence)),
            }
            self._update(change_id, values)

    def merge(self, part_id: int, whole_id: int) -> None:
        """A change turns out to be part of another: its points and its history go there, and its row goes.

        `merged_changes` keeps where it went.
        """
        with self._db.transaction():
            part, whole = self.get(part_id), self.get(whole_id)
            self.extend(whole_id, part.points, max(part.confidence, whole.confidence), whole.evidence)
            for (other_id,) in self._db.tuples("SELECT id FROM changes WHERE superseded_by = ?", (part_id,)):
                self._update(other_id, {"superseded_by": whole_id})
            for column, table in (("change_id", "observations"), ("whole_id", "merged_changes")):
                self._db.write(f"UPDATE {table} SET {column} = ? WHERE {column} = ?", (whole_id, part_id))
            row = {
                "part_id": part_id,
                "whole_id": whole_id,
                "merged_host_ns": time.time_ns(),
                "revision": self._next_revision(),
            }
            self._db.insert("merged_changes", row)
            self._db.write("DELETE FROM changes WHERE id = ?", (part_id,))

    def observe(self, change_id: int, seen: Observation, superseded_by: int | None = None) -> None:
        """Note what a later visit saw of the change; where it is gone, which change undid it, if one did.

        That it was not seen is no news: the change's revision stays.
        """
        with self._db.transaction():
            self.get(change_id, with_points=False)
            self._note(change_id, seen)
            if seen.kind != "unseen":
                self._update(
                    change_id, {"state": "ended", "superseded_by": superseded_by} if seen.kind == "gone" else {}
                )

    def transaction(self) -> AbstractContextManager[None]:
        """What is written inside is there whole or not at all: all that one instance found, for instance."""
        return self._db.transaction()

    def skip_used_numbers(self) -> None:
        """After older contents were restored: ids and revisions that were given since must not be given again.

        They go on from the time in seconds, which no store can have reached at a change each second.
        """
        now_s = int(time.time())
        with self._db.transaction():
            self._db.write("UPDATE store SET last_revision = max(last_revision, ?)", (now_s,))
            self._db.write(
                """INSERT INTO sqlite_sequence (name, seq)
                   SELECT 'changes', 0 WHERE NOT EXISTS (SELECT 1 FROM sqlite_sequence WHERE name = 'changes')"""
            )
            self._db.write("UPDATE sqlite_sequence SET seq = max(seq, ?) WHERE name = 'changes'", (now_s,))

    # Reading ------------------------------------------------------------------------------------------------------

    def get(self, change_id: int, with_points: bool = True) -> ChangeObject:
        """One change. Raises StorageError where there is none of this id."""
        found = self._select("id = ?", [change_id], with_points)
        if not found:
            raise StorageError(f"there is no change {change_id}")
        return found[0]

    def whole_of(self, change_id: int) -> int:
        """The id under which a change is stored now: its own, or that of the change it was merged into."""
        return self._db.value(
            "SELECT coalesce((SELECT whole_id FROM merged_changes WHERE part_id = ?), ?)", (change_id, change_id)
        )

    def changes(
        self,
        *,
        min_points: int = 0,
        polarity: str | None = None,
        map_id: int | None = None,
        box: tuple[np.ndarray, np.ndarray] | None = None,
        before: tuple[int, int] | None = None,
        with_points: bool = True,
    ) -> list[ChangeObject]:
        """Changes, in the order of their first sight.

        box: lower and upper corner (3,) metres, map frame; changes whose own box touches it. before: (session,
        sensor ns); changes first seen earlier, where every moment of an earlier session is earlier.
        """
        terms: list[tuple[str, list[Any]]] = [("n_points >= ?", [min_points])]
        if polarity is not None:
            terms.append(("polarity = ?", [polarity]))
        if map_id is not None:
            terms.append(("map_id = ?", [map_id]))
        if box is not None:
            lower, upper = (np.asarray(corner, np.float64).tolist() for corner in box)
            terms.append(("min_x <= ? AND min_y <= ? AND min_z <= ?", upper))
            terms.append(("max_x >= ? AND max_y >= ? AND max_z >= ?", lower))
        if before is not None:
            terms.append(("(session_id, first_seen_ns) < (?, ?)", list(before)))
        where = " AND ".join(sql for sql, _ in terms)
        return self._select(where, [value for _, values in terms for value in values], with_points)

    def count_present(self) -> int:
        """Changes that hold."""
        return self._db.value("SELECT count(*) FROM changes WHERE state = 'present'")

    def since(self, revision: int, with_points: bool = False) -> list[ChangeObject | MergedChange]:
        """What is new or altered after a revision, in the order of revisions; each change once, as it is now.

        Exact: whoever goes on from the last one's revision misses nothing and sees nothing twice unaltered.
        """
        with self._db.snapshot():
            changed = self._select("revision > ?", [revision], with_points)
            merged = self._db.rows(
                "SELECT revision, part_id AS id, whole_id AS into_id FROM merged_changes WHERE revision > ?",
                (revision,),
            )
        return sorted([*changed, *(MergedChange(**row) for row in merged)], key=lambda entry: entry.revision)

    def publish_change_list(self, n: int) -> list[ChangeObject]:
        """Metadata of all changes of at least n points, without the points (CDSD section III-D)."""
        return self.changes(min_points=n, with_points=False)

    def history(self, change_id: int) -> list[dict[str, Any]]:
        """What the visits saw of a change, oldest first: kind, session_id, scene_id, visit, time_ns and the shares."""
        return self._db.rows(
            """SELECT kind, session_id, scene_id, visit, time_ns, share_still, share_undone FROM observations
               WHERE change_id = ? ORDER BY observation_id""",
            (change_id,),
        )

    def _select(self, where: str, values: list[Any], with_points: bool) -> list[ChangeObject]:
        columns = OTHER_COLUMNS + (", points" if with_points else "")
        rows = self._db.rows(
            f"SELECT {columns} FROM changes WHERE {where} ORDER BY session_id, first_seen_ns, id", values
        )
        with self._db.decoding():
            return [change_object(row) for row in rows]

    # Parts of a transaction ---------------------------------------------------------------------------------------

    def _note(self, change_id: int, seen: Observation) -> None:
        row = {
            "change_id": change_id,
            "kind": seen.kind,
            "session_id": seen.session,
            "scene_id": seen.scene,
            "visit": seen.visit,
            "time_ns": seen.time_ns,
            "share_still": seen.share_still,
            "share_undone": seen.share_undone,
        }
        self._db.insert("observations", row)

    def _update(self, change_id: int, values: Mapping[str, Any]) -> None:
        values = {**values, "revision": self._next_revision(), "updated_host_ns": time.time_ns()}
        assignments = ", ".join(f"{name} = ?" for name in values)
        self._db.write(f"UPDATE changes SET {assignments} WHERE id = ?", (*values.values(), change_id))

    def _next_revision(self) -> int:
        """In a transaction: what is committed later has higher revisions, so a reader misses nothing."""
        return self._db.value("UPDATE store SET last_revision = last_revision + 1 RETURNING last_revision")
