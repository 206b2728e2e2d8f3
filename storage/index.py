"""index.db: sessions, scans, descriptors, scenes, visits and detection instances. Can be rebuilt from the scan files.

Synchronous NORMAL: a killed process loses nothing, a power cut may lose the last commits, whose scan files remain.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from . import database
from .rows import (
    POSE,
    DueVisit,
    InstanceRow,
    SceneRow,
    SceneScans,
    SessionRow,
    Trajectory,
    VisitRow,
    descriptor_array,
    trajectory_columns,
)
from .scans import Scan
from .schema import INDEX_MIGRATIONS

BUSY_TIMEOUT_S = 0.2  # the frame loop writes here: it may be late by two frames, then it goes on without


class IndexStore:
    """The open index. Thread rule: any thread may call any method; one connection behind one lock."""

    def __init__(self, connection: database.Connection):
        self.db = connection  # for the other modules of the storage

    @classmethod
    def open_writer(cls, path: Path, store_uuid: str) -> IndexStore:
        """Open or make. Raises DatabaseFileError, NewerFormat, DataDirError."""
        return cls(database.open_writer(path, INDEX_MIGRATIONS, "NORMAL", BUSY_TIMEOUT_S, store_uuid))

    @classmethod
    def open_reader(cls, path: Path) -> IndexStore:
        """Open read-only, beside the writer. Raises DatabaseFileError, NewerFormat."""
        return cls(database.open_reader(path, len(INDEX_MIGRATIONS)))

    def read_through(self) -> None:
        """Read every row as the program does. Raises DatabaseCorrupt."""
        self.trajectory()
        for scene in self.scenes():
            self.visits(scene.scene_id)
            self.scans_of_scene(scene.scene_id)

    def close(self) -> None:
        self.db.close()

    def transaction(self) -> AbstractContextManager[None]:
        """What is written inside is there whole or not at all: a key scan with its visits, for instance."""
        return self.db.transaction()

    # Sessions -----------------------------------------------------------------------------------------------------

    def start_session(
        self,
        *,
        source: str,
        sensor_digest: str,
        serial: str,
        product: str,
        firmware: str,
        profile: str,
        clock_source: str,
        config: str,
        software_version: str,
        map_id: int | None = None,
        continues: int | None = None,
    ) -> int:
        """Note a new session and return its id. map_id None: it makes a new map, whose id is the session's.

        continues: the session that goes on as this one, in an older map. Closes what a killed process left open.
        """
        with self.db.transaction():
            self._close_open_visits()
            row = {
                "map_id": map_id or 0,
                "source": source,
                "started_host_ns": time.time_ns(),
                "sensor_digest": sensor_digest,
                "serial": serial,
                "product": product,
                "firmware": firmware,
                "profile": profile,
                "clock_source": clock_source,
                "config": config,
                "software_version": software_version,
                "continues": continues,
            }
            session_id = self.db.insert("sessions", row)
            if map_id is None:
                self.db.write("UPDATE sessions SET map_id = session_id WHERE session_id = ?", (session_id,))
            return session_id

    def end_session(self, session_id: int) -> None:
        """Note the end of a session, and of the visits still open."""
        with self.db.transaction():
            self._close_open_visits()
            self.db.write("UPDATE sessions SET ended_host_ns = ? WHERE session_id = ?", (time.time_ns(), session_id))

    def sessions(self) -> list[SessionRow]:
        """All sessions, oldest first."""
        columns = "session_id, map_id, source, sensor_digest, started_host_ns, config, continues"
        return [SessionRow(**row) for row in self.db.rows(f"SELECT {columns} FROM sessions ORDER BY session_id")]

    def maps_to_join(self) -> list[int]:
        """Maps that have scenes and were not given up for an older one, oldest first."""
        rows = self.db.tuples(
            """SELECT DISTINCT map_id FROM scenes
               WHERE map_id NOT IN (SELECT continues FROM sessions WHERE continues IS NOT NULL) ORDER BY map_id"""
        )
        return [row[0] for row in rows]

    def _close_open_visits(self) -> None:
        """A visit ends with its last scan where nobody noted its end."""
        self.db.write(
            """UPDATE visits SET t_out_ns = coalesce(
                   (SELECT max(s.stamp_ns) FROM visit_scans AS vs JOIN scans AS s USING (scan_id)
                    WHERE vs.visit_id = visits.visit_id), t_in_ns)
               WHERE t_out_ns IS NULL"""
        )

    # Scans --------------------------------------------------------------------------------------------------------

    def next_scan_id(self) -> int:
        """The lowest scan id that was never used by this index."""
        return self._next_id("scans")

    def add_scan(self, scan: Scan, n_bytes: int) -> None:
        """Note a key scan whose file of n_bytes is written."""
        quaternion = Rotation.from_matrix(scan.T_map_sensor[:3, :3]).as_quat()
        row = {
            "scan_id": scan.scan_id,
            "session_id": scan.session,
            "stamp_ns": scan.stamp_ns,
            "host_ns": scan.host_ns,
            **dict(zip("xyz", scan.T_map_sensor[:3, 3].tolist(), strict=True)),
            **dict(zip(("qx", "qy", "qz", "qw"), quaternion.tolist(), strict=True)),
            "aligned": int(scan.aligned),
            "residual_m": scan.alignment_residual_m,  # NaN becomes NULL
            "bytes": n_bytes,
        }
        descriptor = {
            "scan_id": scan.scan_id,
            "model_id": scan.model_id,
            "descriptor": np.asarray(scan.descriptor, "<f4").tobytes(),
        }
        with self.db.transaction():
            self.db.insert("scans", row)
            self.db.insert("descriptors", descriptor)

    def trajectory(self, session: int | None = None) -> Trajectory:
        """Poses of all key scans, or of one session's."""
        where, values = ("WHERE s.session_id = ?", (session,)) if session is not None else ("", ())
        rows = self.db.tuples(f"SELECT {POSE} FROM scans AS s {where} ORDER BY s.scan_id", values)
        with self.db.decoding():
            return Trajectory(**trajectory_columns(rows))

    def all_descriptors(self, model_id: str) -> tuple[np.ndarray, np.ndarray]:
        """Scan ids (N,) int64, ascending, and descriptors (N, D) float32 of all scans described by this model."""
        rows = self.db.tuples(
            "SELECT scan_id, descriptor FROM descriptors WHERE model_id = ? ORDER BY scan_id", (model_id,)
        )
        with self.db.decoding():
            return np.array([row[0] for row in rows], np.int64), descriptor_array([row[1] for row in rows])

    def scene_descriptors(self, model_id: str, maps: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Of all scans in scenes of some maps, described by this model: scene (N,) int64, descriptor (N, D)."""
        maps = list(maps)
        rows = self.db.tuples(
            f"""SELECT s.scene_id, d.descriptor
                FROM scenes AS s JOIN visits USING (scene_id) JOIN visit_scans USING (visit_id)
                     JOIN descriptors AS d USING (scan_id)
                WHERE d.model_id = ? AND s.map_id IN ({", ".join("?" * len(maps))}) ORDER BY s.scene_id, scan_id""",
            (model_id, *maps),
        )
        with self.db.decoding():
            return np.array([row[0] for row in rows], np.int64), descriptor_array([row[1] for row in rows])

    def count_scans(self) -> int:
        """Key scans in the store."""
        return self.db.value("SELECT count(*) FROM scans")

    # Scenes and visits --------------------------------------------------------------------------------------------

    def next_scene_id(self) -> int:
        """The lowest scene id that was never used."""
        return self._next_id("scenes")

    def add_scene(self, scene_id: int, map_id: int, hull: np.ndarray, margin_m: float, area_m2: float) -> None:
        """Note a scene. hull (M, 2) metres, map frame."""
        row = {
            "scene_id": scene_id,
            "map_id": map_id,
            "hull": json.dumps(np.asarray(hull, np.float64).tolist()),
            "margin_m": margin_m,
            "area_m2": area_m2,
            "created_host_ns": time.time_ns(),
        }
        self.db.insert("scenes", row)

    def scenes(self, map_id: int | None = None) -> list[SceneRow]:
        """All scenes of a map, or of all maps, by id."""
        where, values = ("WHERE map_id = ?", (map_id,)) if map_id is not None else ("", ())
        rows = self.db.rows(
            f"""SELECT scene_id, map_id, hull, margin_m, area_m2,
                       (SELECT coalesce(max(number), 0) FROM visits WHERE scene_id = scenes.scene_id) AS n_visits
                FROM scenes {where} ORDER BY scene_id""",
            values,
        )
        with self.db.decoding():
            return [SceneRow(**{**row, "hull": np.array(json.loads(row["hull"])).reshape(-1, 2)}) for row in rows]

    def open_visit(self, scene_id: int, number: int, session: int, t_in_ns: int) -> int:
        """Note that a visit began; its id."""
        row = {"scene_id": scene_id, "number": number, "session_id": session, "t_in_ns": t_in_ns}
        return self.db.insert("visits", row)

    def add_visit_scans(self, visit_id: int, scan_ids: Iterable[int]) -> None:
        """Note scans as part of a visit; those that the retention had to delete meanwhile are passed over."""
        rows = [(visit_id, scan_id) for scan_id in scan_ids]
        self.db.write_many("INSERT INTO visit_scans SELECT ?, scan_id FROM scans WHERE scan_id = ?", rows)

    def close_visit(self, visit_id: int, t_out_ns: int) -> None:
        """Note that a visit ended."""
        self.db.write("UPDATE visits SET t_out_ns = ? WHERE visit_id = ?", (t_out_ns, visit_id))

    def visits(self, scene_id: int) -> list[VisitRow]:
        """All visits to a scene, by number."""
        rows = self.db.rows(
            """SELECT visit_id, scene_id, number, session_id AS session, t_in_ns, t_out_ns
               FROM visits WHERE scene_id = ? ORDER BY number""",
            (scene_id,),
        )
        return [VisitRow(**row) for row in rows]

    def scans_of_scene(self, scene_id: int, *, visit: int | None = None, before_visit: int | None = None) -> SceneScans:
        """Key scans of a scene: of all visits, of visit number `visit`, or of those numbered below `before_visit`."""
        where, values = "", (scene_id,)
        if visit is not None:
            where, values = "AND v.number = ?", (scene_id, visit)
        elif before_visit is not None:
            where, values = "AND v.number < ?", (scene_id, before_visit)
        rows = self.db.tuples(
            f"""SELECT {POSE}, v.number, d.model_id, d.descriptor
                FROM visits AS v JOIN visit_scans USING (visit_id) JOIN scans AS s USING (scan_id)
                     JOIN descriptors AS d USING (scan_id)
                WHERE v.scene_id = ? {where} ORDER BY s.scan_id""",
            values,
        )
        with self.db.decoding():
            return SceneScans(
                **trajectory_columns(rows),
                visit_number=np.array([row[11] for row in rows], np.int64),
                model_id=np.array([row[12] for row in rows], np.str_),
                descriptors=descriptor_array([row[13] for row in rows]),
            )

    def latest_visit_numbers(self) -> dict[int, int]:
        """Scan id -> the highest number among the visits it is part of; scans outside all scenes are left out."""
        return dict(
            self.db.tuples("SELECT scan_id, max(number) FROM visit_scans JOIN visits USING (visit_id) GROUP BY scan_id")
        )

    # Instances ----------------------------------------------------------------------------------------------------

    def record_instance(self, instance: InstanceRow) -> int:
        """Note how one run of change detection went; its id."""
        row = {
            **vars(instance),
            "stage_seconds": json.dumps(dict(instance.stage_seconds or {})),
            "finished_host_ns": time.time_ns(),
        }
        return self.db.insert("instances", row)

    def visits_due(self) -> list[DueVisit]:
        """Visits that were to be compared and of which no instance is recorded, oldest first."""
        rows = self.db.rows(
            """SELECT v.session_id, s.map_id, v.scene_id, v.visit_id, v.number AS visit, v.t_in_ns, v.t_out_ns
               FROM visits AS v JOIN scenes AS s USING (scene_id)
               WHERE v.number >= 2 AND v.t_out_ns IS NOT NULL
                     AND v.visit_id NOT IN (SELECT visit_id FROM instances)
               ORDER BY v.visit_id"""
        )
        return [DueVisit(**row) for row in rows]

    def counts(self) -> dict[str, int]:
        """Rows of each kind, the bytes of all scan files, and the instances by status."""
        tables = ("sessions", "scans", "scenes", "visits")
        counts = {table: self.db.value(f"SELECT count(*) FROM {table}") for table in tables}
        counts["scan_bytes"] = self.db.value("SELECT coalesce(sum(bytes), 0) FROM scans")
        for status in ("done", "rejected", "dropped", "failed"):
            counts[f"instances_{status}"] = self.db.value("SELECT count(*) FROM instances WHERE status = ?", (status,))
        return counts

    def _next_id(self, table: str) -> int:
        return self.db.value("SELECT coalesce(max(seq), 0) + 1 FROM sqlite_sequence WHERE name = ?", (table,))
