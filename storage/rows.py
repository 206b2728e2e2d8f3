"""What the index holds, as the rest of the program sees it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from typing import Self


@dataclass(frozen=True)
class SessionRow:
    """One run of the odometry, without a break."""

    session_id: int
    map_id: int  # the session whose first scan is the map's origin
    source: str
    sensor_digest: str
    started_host_ns: int
    config: str  # TOML
    continues: int | None  # the session that went on as this one when its place in the map was found


@dataclass(frozen=True, eq=False)
class SceneRow:
    """A place: a convex hull of positions, grown by a margin."""

    scene_id: int
    map_id: int
    hull: np.ndarray  # (M, 2) float64 metres, map frame, counter-clockwise
    margin_m: float
    area_m2: float  # of the grown hull
    n_visits: int


@dataclass(frozen=True)
class VisitRow:
    """One stay in a scene."""

    visit_id: int
    scene_id: int
    number: int  # 1 is the visit that made the scene
    session: int
    t_in_ns: int
    t_out_ns: int | None  # None: the robot is still there


@dataclass(frozen=True)
class DueVisit:
    """A visit whose instance of change detection no run has recorded yet."""

    session_id: int
    map_id: int
    scene_id: int
    visit_id: int
    visit: int  # its number, at least 2
    t_in_ns: int
    t_out_ns: int


@dataclass(frozen=True)
class InstanceRow:
    """One run of change detection, as it is recorded."""

    scene_id: int
    visit_id: int
    status: str  # done | rejected | dropped | failed
    reason: str = ""  # why it is not done
    seconds: float = 0.0
    stage_seconds: Mapping[str, float] | None = None
    n_cumulative_scans: int = 0
    n_recent_scans: int = 0
    n_candidates: int = 0  # points
    n_confirmed: int = 0  # points
    n_changes: int = 0  # objects
    alignment_residual_m: float | None = None


@dataclass(frozen=True, eq=False)
class Trajectory:
    """N key scans in the order of their ids, which is that of time."""

    scan_id: np.ndarray  # (N,) int64
    session: np.ndarray  # (N,) int64
    stamp_ns: np.ndarray  # (N,) int64, sensor clock of the session
    T_map_sensor: np.ndarray  # (N, 4, 4) float64, at each scan's end
    aligned: np.ndarray  # (N,) bool

    def only(self, rows: np.ndarray) -> Self:
        """The scans of these rows: (N,) bool, or indices."""
        return type(self)(**{name: column[rows] for name, column in vars(self).items()})


@dataclass(frozen=True, eq=False)
class SceneScans(Trajectory):
    """N key scans of one scene, each once."""

    visit_number: np.ndarray  # (N,) int64
    descriptors: np.ndarray  # (N, D) float32, unit
    model_id: np.ndarray  # (N,) str, of the descriptors


POSE = "s.scan_id, s.session_id, s.stamp_ns, s.aligned, s.x, s.y, s.z, s.qx, s.qy, s.qz, s.qw"  # of scans AS s


def trajectory_columns(rows: list[tuple]) -> dict[str, np.ndarray]:
    """Rows that begin with POSE -> the columns of a Trajectory."""
    poses = np.array([row[4:11] for row in rows], np.float64).reshape(-1, 7)
    T_map_sensor = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows:
        T_map_sensor[:, :3, :3] = Rotation.from_quat(poses[:, 3:]).as_matrix()
        T_map_sensor[:, :3, 3] = poses[:, :3]
    return {
        "scan_id": np.array([row[0] for row in rows], np.int64),
        "session": np.array([row[1] for row in rows], np.int64),
        "stamp_ns": np.array([row[2] for row in rows], np.int64),
        "aligned": np.array([row[3] for row in rows], bool),
        "T_map_sensor": T_map_sensor,
    }


def descriptor_array(blobs: list[bytes]) -> np.ndarray:
    """Equal-length blobs of float32 -> (N, D) float32."""
    return np.frombuffer(b"".join(blobs), "<f4").reshape(len(blobs), -1 if blobs else 0).astype(np.float32)
