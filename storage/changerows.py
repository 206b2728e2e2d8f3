"""What changes.db holds, as the rest of the program sees it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .errors import StorageError

POINT_VOXEL_M = 0.05  # a change holds at most one point in each such cube, so that n_points means the same always


@dataclass(frozen=True, eq=False)
class Change:
    """What a detection found. Times are of the sensor's clock in `session`, unless they say host."""

    polarity: str  # appeared | disappeared
    map_id: int
    session: int
    scene: int
    visit: int  # number of the scene's visit that found it
    first_seen_ns: int  # the new state was first seen
    first_seen_host_ns: int  # the same moment, ns since 1970
    points: np.ndarray | None  # (N, 3) float32, metres, map frame; None where it was read without them
    confidence: float  # 0..1
    evidence: Mapping[str, Any]  # what each filter saw; goes to JSON
    alignment_residual_m: float
    model_id: str
    config_digest: str
    last_before_session: int | None = None  # the old state was last seen
    last_before_ns: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeObject(Change):
    """A change as it is stored."""

    id: int
    revision: int  # grows with each new or altered change
    state: str  # present | ended
    superseded_by: int | None  # the change that ended this one
    centroid: np.ndarray  # (3,) float64, metres, map frame
    box_min: np.ndarray  # (3,)
    box_max: np.ndarray  # (3,)
    n_points: int
    detected_host_ns: int
    updated_host_ns: int


@dataclass(frozen=True)
class Observation:
    """What a visit saw of a change: it `appeared`, `disappeared`, is `still` so, `gone` (undone), or `unseen`."""

    kind: str
    session: int
    scene: int
    visit: int  # number of the scene's visit
    time_ns: int  # sensor's clock in `session`
    share_still: float | None = None  # of its points, seen in its state; None where it was not looked for
    share_undone: float | None = None  # ... and in the state before it


@dataclass(frozen=True)
class MergedChange:
    """A change that turned out to be part of another, and is none any more."""

    revision: int
    id: int
    into_id: int


# Every column but the points, under the names of ChangeObject's fields.
OTHER_COLUMNS = """
    id, revision, polarity, state, superseded_by, map_id, session_id AS session, scene_id AS scene, visit,
    first_seen_ns, first_seen_host_ns, last_before_session, last_before_ns, x, y, z,
    min_x, min_y, min_z, max_x, max_y, max_z, n_points, confidence, evidence, alignment_residual_m,
    model_id, config_digest, detected_host_ns, updated_host_ns"""


def one_per_voxel(points: np.ndarray) -> np.ndarray:
    """The first of the points (N, 3) in each voxel, as float32, in their order."""
    points = np.asarray(points, np.float32).reshape(-1, 3)
    voxel = np.floor(points.astype(np.float64) / POINT_VOXEL_M).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return points[np.sort(first)]


def point_columns(points: np.ndarray) -> dict[str, Any]:
    """All columns that follow from the points (N, 3) float32."""
    if len(points) == 0:
        raise StorageError("a change without points cannot be stored")
    centroid = points.mean(axis=0, dtype=np.float64).tolist()
    lower, upper = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    columns = ("x", "y", "z", "min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
    return {
        **dict(zip(columns, centroid + lower + upper, strict=True)),
        "n_points": len(points),
        "points": np.ascontiguousarray(points, "<f4").tobytes(),
    }


def change_object(row: dict[str, Any]) -> ChangeObject:
    """A row of the table -> a ChangeObject."""
    row["centroid"] = np.array([row.pop(name) for name in ("x", "y", "z")])
    row["box_min"] = np.array([row.pop(name) for name in ("min_x", "min_y", "min_z")])
    row["box_max"] = np.array([row.pop(name) for name in ("max_x", "max_y", "max_z")])
    blob = row.pop("points", None)
    row["points"] = None if blob is None else np.frombuffer(blob, "<f4").reshape(-1, 3).astype(np.float32)
    row["evidence"] = json.loads(row["evidence"])
    if row["alignment_residual_m"] is None:
        row["alignment_residual_m"] = np.nan
    return ChangeObject(**row)
