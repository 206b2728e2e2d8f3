"""What is stored, as text for people and for programs. Pure functions: the commands print what they return."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..storage.changerows import ChangeObject

if TYPE_CHECKING:  # its compiled loops take a second to import
    from .places import PlaceSeen

DECIMALS = 4  # of metres in JSON and CSV: a tenth of a millimetre, where the sensor knows centimetres
SECOND_NS = 1_000_000_000


def changes_table(changes: Sequence[ChangeObject]) -> str:
    """Aligned columns for people, metres in the map frame; the time is the host's clock, UTC."""
    if not changes:
        return "no changes"
    rows = [("id", "polarity", "state", "x", "y", "z", "points", "scene", "visit", "first seen (UTC)")]
    for change in changes:
        x, y, z = (f"{value:.2f}" for value in change.centroid)
        numbers = (str(change.n_points), str(change.scene), str(change.visit))
        rows.append((str(change.id), change.polarity, change.state, x, y, z, *numbers, _utc(change)))
    return _aligned(rows, left={1, 2, 9})


def place_table(history: Sequence[PlaceSeen]) -> str:
    """Aligned columns for people: what each visit saw of a place."""
    if not history:
        return "no visit came near"
    rows = [("session", "scene", "visit", "scans", "occupied", "free", "state", "against the last")]
    for seen in history:
        shares = f"{seen.share_occupied:.0%}", f"{seen.share_free:.0%}"
        numbers = str(seen.session), str(seen.scene), str(seen.visit), str(seen.n_scans)
        rows.append((*numbers, *shares, seen.state, seen.verdict))
    return _aligned(rows, left={6, 7})


def place_json(history: Sequence[PlaceSeen]) -> str:
    """A JSON list, one visit on each line, under the names of PlaceSeen."""
    lines = [json.dumps(asdict(seen)) for seen in history]
    return "[" + ",".join(f"\n  {line}" for line in lines) + "\n]" if lines else "[]"


def _aligned(rows: list[tuple[str, ...]], left: set[int]) -> str:
    """Columns two spaces apart, those named aligned to the left, the others to the right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell.ljust(widths[i]) if i in left else cell.rjust(widths[i]) for i, cell in enumerate(row)]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def changes_json(changes: Sequence[ChangeObject], with_points: bool) -> str:
    """A JSON list, one change on each line; with_points: the changes must have been read with theirs."""
    lines = [json.dumps(change_fields(change, with_points)) for change in changes]
    return "[" + ",".join(f"\n  {line}" for line in lines) + "\n]" if lines else "[]"


def change_fields(change: ChangeObject, with_points: bool) -> dict:
    """What programs are told of a change; with_points: it must have been read with its points."""
    fields = {
        "id": change.id,
        "polarity": change.polarity,
        "centroid": _rounded(change.centroid),
        "n_points": change.n_points,
        "first_seen_ns": change.first_seen_ns,
        "scene": change.scene,
        "visit": change.visit,
        "session": change.session,
    }
    if with_points:
        fields["points"] = _rounded(change.points)
    return fields


def changes_csv(changes: Sequence[ChangeObject]) -> str:
    """CSV with a header line: all that is known of each change but its points and evidence."""
    corners = [f"{side}_{axis}_m" for side in ("min", "max") for axis in "xyz"]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        ["id", "polarity", "state", "x_m", "y_m", "z_m", *corners, "n_points", "confidence"]
        + ["first_seen_ns", "first_seen_utc", "session", "scene", "visit"]
    )
    for change in changes:
        place = _rounded(np.concatenate([change.centroid, change.box_min, change.box_max]))
        table.writerow(
            [change.id, change.polarity, change.state, *place, change.n_points, round(change.confidence, 4)]
            + [change.first_seen_ns, _utc(change), change.session, change.scene, change.visit]
        )
    return text.getvalue()


def trajectory_tum(stamps_ns: np.ndarray, poses: np.ndarray) -> str:
    """Lines `t x y z qx qy qz qw`: stamps (N,) int64 ns and poses (N, 4, 4), T_map_sensor.

    t in seconds has all nine decimals: a float64 would round the nanoseconds of a clock that counts since 1970.
    """
    if len(poses) == 0:
        return ""
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    values = np.hstack([poses[:, :3, 3], quaternions])
    lines = []
    for stamp_ns, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        seconds, ns = divmod(stamp_ns, SECOND_NS)
        lines.append(f"{seconds}.{ns:09d} " + " ".join(f"{value:.6f}" for value in row) + "\n")
    return "".join(lines)


def _rounded(metres: np.ndarray) -> list:
    return (np.round(np.asarray(metres, np.float64), DECIMALS) + 0.0).tolist()  # + 0.0 turns -0 into 0


def _utc(change: ChangeObject) -> str:
    moment = datetime.fromtimestamp(change.first_seen_host_ns / SECOND_NS, timezone.utc)
    return moment.strftime("%Y-%m-%d %H:%M:%S")
