"""Virtual patrols, made and replayed once, and what was found on them held against the truth of their worlds."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from revisitd.drivers.virtual import Capture, simulate
from revisitd.storage.changerows import ChangeObject, one_per_voxel
from revisitd.storage.store import Store

MATCH_M = 1.0  # CDSD section V-A: a change of the same polarity within 1 m of the true one
OWN_M = 0.3  # a reported point so near to a staged change's surface is of it
COVER_M, COVER_VOXEL_M = 0.15, 0.10  # a 10 cm voxel of the surface is covered by a reported point within 15 cm
LARGE = 125  # points, from which a false change is large (CDSD section V-A)


@dataclass
class Score:
    """One patrol's figures. For each staged change, 0 where it was missed:"""

    kinds: list[str]
    by_points: list[float]  # points reported over confirmable ones, both one for each 5 cm voxel
    by_surface: list[float]  # share of its confirmable surface that is covered
    false: list[ChangeObject] = field(default_factory=list)
    duplicates: int = 0
    rms_m: float = 0.0
    max_m: float = 0.0

    @property
    def n_found(self) -> int:
        """Staged changes that were found at all."""
        return sum(share > 0 for share in self.by_surface)

    @property
    def small(self) -> int:
        """False changes of fewer than 125 points."""
        return sum(change.n_points < LARGE for change in self.false)

    @property
    def large(self) -> int:
        """False changes of 125 points or more."""
        return len(self.false) - self.small


def capture(work: Path, scenario: str, seed: int, beams: int, profile: str) -> Capture:
    """The capture of a patrol in the work folder; simulated where it is not there yet."""
    folder = work / f"{scenario}{seed}_{beams}_{profile.split('_')[0]}"
    made = Capture(folder / "capture.pcap", folder / "capture.json", folder / "truth")
    if not (made.truth / "changes.json").exists():
        simulate(folder, scenario, seed, beams=beams, profile=profile)
    return made


def score(data: Path, truth: Path) -> Score:
    """Hold what is stored against the truth of the virtual world.

    Only what a visit could confirm counts of a staged change: places that the other visits looked through.
    """
    staged = json.loads((truth / "changes.json").read_text())
    with Store.open_reader(data) as store:
        found, path = store.changes.changes(), store.index.trajectory()
    result = Score([f"{change['kind']} {change['polarity']}" for change in staged], [], [])
    matched: set[int] = set()
    for change in staged:
        surface = _confirmable(change)
        centroid = np.array(change["centroid"])
        near = [o for o in found if o.polarity == change["polarity"] and _is_of(o, surface, centroid)]
        result.duplicates += max(0, len([o for o in near if o.id not in matched]) - 1)
        matched |= {o.id for o in near}
        result.by_points.append(min(1.0, sum(o.n_points for o in near) / max(1, len(one_per_voxel(surface)))))
        result.by_surface.append(_covered(surface, near))
    result.false = [o for o in found if o.id not in matched]
    result.rms_m, result.max_m = trajectory_error(path.stamp_ns, path.T_map_sensor, truth)
    return result


def trajectory_error(stamp_ns: np.ndarray, T_map_sensor: np.ndarray, truth: Path) -> tuple[float, float]:
    """Root mean square and largest position error (m), not aligned: both maps begin at the first frame's end."""
    true = np.loadtxt(truth / "poses.txt")
    true_ns = np.round(true[:, 0] * 1e9).astype(np.int64)
    at = np.abs(true_ns[None] - stamp_ns[:, None]).argmin(axis=1)
    error = np.linalg.norm(T_map_sensor[:, :3, 3] - true[at, 1:4], axis=1)
    return float(np.sqrt((error**2).mean())), float(error.max())


def _confirmable(change: dict) -> np.ndarray:
    points = np.array(change["points"], np.float32).reshape(-1, 3)
    return points[np.array(change["confirmable"]) > 0]


def _is_of(found: ChangeObject, surface: np.ndarray, centroid: np.ndarray) -> bool:
    """Within a metre of the staged change, or made of its surface."""
    if np.linalg.norm(found.centroid - centroid) <= MATCH_M:
        return True
    distance, _ = cKDTree(surface).query(found.points, distance_upper_bound=OWN_M)
    return bool(np.isfinite(distance).mean() >= 0.5)


def _covered(surface: np.ndarray, found: list[ChangeObject]) -> float:
    if not found:
        return 0.0
    voxel = np.floor(surface / np.float32(COVER_VOXEL_M)).astype(np.int64)
    visible = surface[np.unique(voxel, axis=0, return_index=True)[1]]
    tree = cKDTree(np.concatenate([change.points for change in found]))
    return float(np.isfinite(tree.query(visible, distance_upper_bound=COVER_M)[0]).mean())
