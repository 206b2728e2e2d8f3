"""The demo's last word: what the patrol's truth says was to be found, and what was."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from ..storage.changerows import ChangeObject
from ..storage.store import Store

MATCH_M = 1.0  # CDSD section V-A: same polarity, within a metre


def fresh(out: Path) -> None:
    """Empty a demo's folder of an earlier demo's files; nothing else in it is touched."""
    for part in ("patrol", "data"):
        shutil.rmtree(out / part, ignore_errors=True)


def compare_with_truth(data: Path, truth: Path) -> str:
    """One line for each staged change, and one for what was reported beyond them."""
    staged = json.loads((truth / "changes.json").read_text(encoding="utf-8"))
    with Store.open_reader(data) as store:
        found = store.changes.changes(with_points=False)
    lines, used = ["What was staged, and what was found of it:"], set()
    for change in staged:
        matches = [other for other in found if _match(other, change)]
        used |= {other.id for other in matches}
        x, y, z = change["centroid"]
        verdict = "found: " + ", ".join(f"id {other.id}" for other in matches) if matches else "missed"
        name = change["kind"].replace("_", " ")
        lines.append(f"  {name:12s} {change['polarity']:12s} at {x:7.2f} {y:7.2f} {z:6.2f}  {verdict}")
    beyond = [other.id for other in found if other.id not in used]
    lines.append(f"  reported beyond that: {len(beyond)}" + (f" (ids {beyond})" if beyond else ""))
    return "\n".join(lines)


def _match(found: ChangeObject, staged: dict) -> bool:
    near = np.linalg.norm(found.centroid - np.array(staged["centroid"])) <= MATCH_M
    return found.polarity == staged["polarity"] and bool(near)
