"""How much of a virtual patrol's changes is found, and what is reported beside them.

    python tests/benchmarks/patrols.py --scenario short --seeds 1 2 --work /tmp/patrols

Simulates each patrol into the work folder (kept: a second run replays it only), replays it at full speed, and prints
one line for each: changes found (same polarity, within 1 m, CDSD section V-A), the share of their visible 5 cm voxels
with a reported point within 15 cm, false changes below and from 125 points, key scans' error against the true poses,
median seconds of an instance, frames/s of the whole replay, and peak memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sqlite3
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from revisitd.daemon.config import Config, load_config
from revisitd.daemon.replay import replay
from revisitd.drivers.virtual import Capture, simulate
from revisitd.storage.store import Store

MATCH_M, COVER_M, LARGE = 1.0, 0.15, 125


@dataclass
class Score:
    """One patrol's figures."""

    n_staged: int
    n_found: int
    covered: list[float]  # of each staged change, 0 where it was missed
    small: int
    large: int
    duplicates: int
    rms_m: float
    max_m: float


def score(data: Path, truth: Path) -> Score:
    """Hold what is stored against the truth of the virtual world."""
    staged = json.loads((truth / "changes.json").read_text())
    with Store.open_reader(data) as store:
        found, path = store.changes.changes(), store.index.trajectory()
    used, covered = set(), []
    for change in staged:
        centroid, surface = np.array(change["centroid"]), np.array(change["points"]).reshape(-1, 3)
        matches = [
            other
            for other in found
            if other.polarity == change["polarity"] and np.linalg.norm(other.centroid - centroid) <= MATCH_M
        ]
        used |= {other.id for other in matches}
        points = np.concatenate([other.points for other in matches]) if matches else np.full((1, 3), np.inf)
        near = cKDTree(points).query(surface, distance_upper_bound=COVER_M)[0] if matches else np.full(1, np.inf)
        covered.append(float(np.isfinite(near).mean()))
    false = [other.n_points for other in found if other.id not in used]
    n_found = sum(share > 0 for share in covered)
    rms_m, max_m = trajectory_error(path.stamp_ns, path.T_map_sensor, truth)
    small, large = sum(n < LARGE for n in false), sum(n >= LARGE for n in false)
    return Score(len(staged), n_found, covered, small, large, len(used) - n_found, rms_m, max_m)


def trajectory_error(stamp_ns: np.ndarray, T_map_sensor: np.ndarray, truth: Path) -> tuple[float, float]:
    """Root mean square and largest position error (m), not aligned: both maps begin at the first frame's end."""
    true = np.loadtxt(truth / "poses.txt")
    true_ns = np.round(true[:, 0] * 1e9).astype(np.int64)
    at = np.abs(true_ns[None] - stamp_ns[:, None]).argmin(axis=1)
    error = np.linalg.norm(T_map_sensor[:, :3, 3] - true[at, 1:4], axis=1)
    return float(np.sqrt((error**2).mean())), float(error.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="short")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--beams", type=int, default=128)
    parser.add_argument("--profile", default="RNG19_RFL8_SIG16_NIR16")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    arguments = parser.parse_args()
    config: Config = load_config(arguments.config)
    for seed in arguments.seeds:
        folder = arguments.work / f"{arguments.scenario}{seed}_{arguments.beams}_{arguments.profile.split('_')[0]}"
        capture = Capture(folder / "capture.pcap", folder / "capture.json", folder / "truth")
        if not (capture.truth / "changes.json").exists():
            simulate(folder, arguments.scenario, seed, beams=arguments.beams, profile=arguments.profile)
        shutil.rmtree(folder / "data", ignore_errors=True)
        summary = replay(str(capture.pcap), folder / "data", None, config, None, lambda *_: None)
        result = score(folder / "data", capture.truth)
        with sqlite3.connect(folder / "data" / "index.db") as index:
            seconds = [row[0] for row in index.execute("SELECT seconds FROM instances WHERE status = 'done'")]
            rejected = index.execute("SELECT count(*) FROM instances WHERE status = 'rejected'").fetchone()[0]
        peak_mib = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        print(
            f"{folder.name}: found {result.n_found}/{result.n_staged}, "
            f"covered {', '.join(f'{share:.0%}' for share in result.covered) or '-'}; "
            f"false {result.small} small {result.large} large, duplicates {result.duplicates}; "
            f"trajectory rms {result.rms_m:.3f} max {result.max_m:.3f} m; "
            f"{len(seconds)} instances of {np.median(seconds or [0]):.2f} s, {rejected} rejected, "
            f"{summary.instances_dropped} dropped; {summary.counts.frames / summary.seconds:.1f} frames/s; "
            f"{peak_mib / 1024:.0f} MiB",
            flush=True,
        )


if __name__ == "__main__":
    main()
