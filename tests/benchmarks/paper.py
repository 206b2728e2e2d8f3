"""The experiments of the paper (CDSD section V) on virtual patrols, its tables beside the paper's own numbers.

    python tests/benchmarks/paper.py --work /tmp/patrols [--seeds 1 2 3 4 5 | --folders F ...] [--tables 1 2 3 4]

A Short Patrol (4 changes; the closed door that an opened one leaves is counted too) and a Long Patrol (18 changes,
three passes, the last against the direction of the first) for each seed, odd seeds with an OS1-128 (RNG15), even ones
with an OS1-64 (RNG19). Patrols are simulated and replayed once, into the work folder; what a table varies is run again
on the stored scans. Table IV's idea: agreement with an offline comparison of the complete maps of successive passes, on
the same poses. Figures go to stdout as the README has them; --plot draws the two sweeps.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from unittest import mock

import numpy as np
from rerun import copy_without_changes, detect_again, detection_on, find_scenes_again, instances_of
from scipy.spatial import cKDTree
from scoring import Score, capture, score

from revisitd.daemon.comparison import Job, Selection
from revisitd.daemon.config import Config
from revisitd.daemon.detection import detector, ground
from revisitd.daemon.replay import replay
from revisitd.daemon.sensors import Sensors
from revisitd.daemon.views import map_points
from revisitd.storage.store import Store

SENSORS = {1: (128, "RNG15_RFL8_NIR8"), 0: (64, "RNG19_RFL8_SIG16_NIR16")}  # by the seed's parity
SCAN_EVERY_M = 2.5  # of the baselines that compare single scans (section V-A)
MAP_SCANS = 40  # of the first pass, the nearest ones, are the prior map of a single scan
OFFLINE_M, AGREE_M, THIN_M = 0.3, 0.5, 0.1
QUEUE = 8  # worker.queue_size

Runs = list[tuple[float, int]]  # seconds of each instance, and when it was due, ns


@dataclass
class Patrol:
    """One replayed patrol."""

    name: str
    data: Path
    truth: Path
    work: Path

    def run(self, variant: str, run: Callable[[Path], Runs]) -> tuple[Score, Runs]:
        """The scores of a variant, run on the stored scans."""
        into = self.work / "again"
        copy_without_changes(self.data, into)
        seconds = run(into)
        result = score(into, self.truth)
        print(f"  {self.name} {variant}: {result.n_found}/{len(result.kinds)}", file=sys.stderr, flush=True)
        return result, seconds


def patrol(work: Path, scenario: str, seed: int) -> Patrol:
    """Simulated and replayed where it is not yet."""
    beams, profile = SENSORS[seed % 2]
    made = capture(work, scenario, seed, beams, profile)
    folder = made.pcap.parent
    if not (folder / "replayed").exists():
        replay(str(made.pcap), folder / "data", None, Config(), None, lambda *_: None)
        (folder / "replayed").touch()
    return Patrol(f"{scenario} {seed}", folder / "data", made.truth, work)


# What a table varies ------------------------------------------------------------------------------------------------


def with_parts(**parts: Callable) -> Callable[[Path], Runs]:
    """The default settings with some functions replaced: detector's by their names, `select` of the instances."""

    def run(data: Path) -> Runs:
        with ExitStack() as stack:
            for name, part in parts.items():
                where = "instances" if name == "select" else "detection.detector"
                stack.enter_context(mock.patch(f"revisitd.daemon.{where}.{name}", part))
            return detect_again(data, Config())

    return run


def equal_stride(descriptors: np.ndarray, visit: np.ndarray, k: int) -> np.ndarray:
    """k scans at equal strides in time, in place of OptMap's choice."""
    return np.unique(np.linspace(0, len(visit) - 1, k).round().astype(int))


def no_ground(points, *_):
    """Labels of a segmentation that finds none."""
    nothing = (np.zeros(shape) for shape in ((0, 3), (0, 3), (0, 3, 3), (0,)))
    return np.zeros(len(points), bool), ground._ground(*nothing)


class EverythingConfirmed(detector.Evidence):
    """The evidence of a detector that does not ask what the other visit saw."""

    def confirmed(self):
        return np.ones(len(self._this.points), bool)

    def possible(self, confirmed):
        return confirmed

    def stayed(self, asked, _):
        return np.ones(len(asked), bool)


NO_OCCLUSION = {
    "Evidence": EverythingConfirmed,
    "scans_looking_through": lambda points, images, *_: np.arange(len(images)),
    "_completion": lambda sure, *_: sure[:0],
    "_counterparts": lambda *_: [],
}
NO_GROUND_FILTER = {"is_ground_like": lambda *_: False}


def single_scans(data: Path, whole_map: bool) -> Runs:
    """Scan-to-submap and scan-to-map: one scan each 2.5 m, against the scene's submap or the first pass's map."""
    runs = []
    with Store.open_writer(data) as store:
        detection, index = detection_on(store, Config()), store.index
        detection._thresholds = replace(detection._thresholds, min_showing_scans=1, min_showing_s=0.0)
        first_pass = _first_pass(store)
        last_at = None
        for instance in instances_of(store):
            job = detection.job(instance)
            scans = index.scans_of_scene(instance.scene_id, visit=instance.visit)
            for i in range(len(scans.scan_id)):
                at = scans.T_map_sensor[i, :3, 3]
                if last_at is not None and np.linalg.norm(at - last_at) < SCAN_EVERY_M:
                    continue
                last_at = at
                ids = scans.session[[i]], scans.scan_id[[i]], scans.visit_number[[i]], scans.stamp_ns[[i]]
                scan = Selection(*ids, at[None], np.ones(1, bool))
                before = _nearest(first_pass, at) if whole_map else job.cumulative
                one = Job(before, scan, job.erasures, [], job.range_m, detection._thresholds)
                comparison = detection._process.compare(one)
                detection._record(comparison, replace(instance, t_in_ns=int(scans.stamp_ns[i])))
                runs.append((sum(comparison.seconds.values()), int(scans.stamp_ns[i])))
    return runs


def _first_pass(store: Store) -> Selection:
    path = store.index.trajectory()
    first = path.only(~path.aligned)
    n, position_m = len(first.scan_id), first.T_map_sensor[:, :3, 3]
    return Selection(
        first.session, first.scan_id, np.ones(n, np.int64), first.stamp_ns, position_m, np.ones(n, dtype=bool)
    )


def _nearest(selection: Selection, at: np.ndarray) -> Selection:
    distance = np.linalg.norm(selection.position_m - at, axis=1)
    return selection.only(np.sort(np.argsort(distance, kind="stable")[:MAP_SCANS]))


TABLE_I = {
    "CDSD": ((89.4, 97.8, 2.1, 2.0, 1.51, 41.8, 0), with_parts()),
    "Scan-to-submap": ((29.4, 53.6, 3.4, 2.2, 0.65, 68.9, 26), lambda data: single_scans(data, False)),
    "Scan-to-map": ((10.6, 16.1, 6.2, 34.1, 2.32, 100.9, 103), lambda data: single_scans(data, True)),
    "w/o OptMap": ((52.2, 79.7, 3.4, 1.0, 1.20, 31.9, 0), with_parts(select=equal_stride)),
    "w/o ground removal": (
        (62.2, 74.7, 2.6, 2.5, 1.61, 44.9, 0),
        with_parts(segment_ground=no_ground, **NO_GROUND_FILTER),
    ),
    "w/o occlusion filter": ((93.9, 93.9, 130.4, 282.2, 2.08, 57.5, 0), with_parts(**NO_OCCLUSION)),
    "w/o noise filter": (
        (88.3, 95.6, 18.9, 6.5, 1.71, 45.5, 0),
        with_parts(dense_enough=lambda points, *_: np.ones(len(points), bool)),
    ),
    "w/o ground filter": ((95.6, 97.8, 16.1, 35.0, 1.55, 43.8, 0), with_parts(**NO_GROUND_FILTER)),
}
TABLE_II = {  # tau: whole, spurious small, large
    0.1: (88.9, 8.6, 8.4),
    0.2: (83.1, 1.5, 3.4),
    0.3: (89.4, 2.1, 2.0),
    0.4: (88.1, 1.7, 1.2),
    0.5: (71.1, 1.4, 0.8),
}
TABLE_III = {  # alpha: whole, spurious of at least 50 points, seconds
    30: (50.0, 4.4, 0.667),
    60: (34.7, 4.1, 0.861),
    120: (89.4, 4.8, 1.51),
    240: (88.9, 5.5, 2.935),
    480: (97.2, 6.8, 5.431),
}


def with_tau(tau_m: float) -> Callable[[Path], Runs]:
    """Another distance of candidates."""
    return lambda data: detect_again(data, Config(detection={"tau_m": tau_m}))


def with_alpha(alpha_m2: float) -> Callable[[Path], Runs]:
    """Another size of scenes, found anew on the same key scans."""

    def run(data: Path) -> Runs:
        config = Config(scenes={"alpha_m2": alpha_m2})
        find_scenes_again(data, config)
        return detect_again(data, config)

    return run


# Figures ------------------------------------------------------------------------------------------------------------


def shares(results: list[Score], of: str, least: float) -> float:
    """Percent of all staged changes of which more than `least` is reported, mean over the patrols' means."""
    return 100.0 * float(np.mean([np.mean([share > least for share in getattr(r, of)]) for r in results]))


def dropped(runs: Runs) -> int:
    """Instances that a full queue would have dropped, had they come in real time."""
    free_at, waiting, n = 0.0, [], 0
    for seconds, due_ns in sorted(runs, key=lambda run: run[1]):
        due = due_ns * 1e-9
        waiting = [t for t in waiting if t > due]
        if len(waiting) > QUEUE:
            n += 1
            continue
        free_at = max(free_at, due) + seconds
        waiting.append(free_at)
    return n


def table_1(patrols: list[Patrol]) -> None:
    """Whole and partial by points, then by surface, and what the paper has in the same order (by points)."""
    names = "whole", "partial", "whole (s)", "partial (s)", "small", "large", "s/inst.", "s/session", "dropped", "paper"
    print("| | " + " | ".join(names) + " |\n" + "|---" * (len(names) + 1) + "|")
    for name, (paper, run) in TABLE_I.items():
        results, runs = zip(*(p.run(name, run) for p in patrols), strict=True)
        figures = [shares(results, of, least) for of in ("by_points", "by_surface") for least in (0.75, 0.5)]
        cost = np.mean([np.mean([s for s, _ in r]) for r in runs]), np.mean([sum(s for s, _ in r) for r in runs])
        print(
            f"| {name} | " + " | ".join(f"{x:.1f}" for x in figures) +
            f" | {np.mean([r.small for r in results]):.1f} | {np.mean([r.large for r in results]):.1f}"
            f" | {cost[0]:.2f} | {cost[1]:.1f} | {np.mean([dropped(r) for r in runs]):.0f}"
            f" | {' / '.join(f'{x:g}' for x in paper)} |",
            flush=True,
        )  # fmt: skip


def sweep(patrols: list[Patrol], name: str, variants: dict, run_with: Callable) -> list[tuple[float, ...]]:
    """One row for each value: whole by points and by surface, small, large, seconds of an instance."""
    print(f"| {name} | whole | whole by surface | small | large | s/inst. | paper |\n|---|---|---|---|---|---|---|")
    rows = []
    for value, paper in variants.items():
        results, runs = zip(*(p.run(f"{name} {value}", run_with(value)) for p in patrols), strict=True)
        figures = [shares(results, of, 0.75) for of in ("by_points", "by_surface")]
        figures += [float(np.mean([getattr(r, size) for r in results])) for size in ("small", "large")]
        figures.append(float(np.mean([np.mean([s for s, _ in r]) for r in runs])))
        rows.append((value, *figures))
        whole, surface, small, large, seconds = figures
        print(f"| {value:g} | {whole:.1f} | {surface:.1f} | {small:.1f} | {large:.1f} | {seconds:.2f} | "
              f"{' / '.join(f'{x:g}' for x in paper)} |", flush=True)  # fmt: skip
    return rows


def table_4(patrols: list[Patrol]) -> None:
    """Agreement with the offline comparison of complete maps, both ways."""
    print("| patrol | our change points that the offline comparison has | its points that we have |\n|---|---|---|")
    for p in patrols:
        into = p.work / "again"
        copy_without_changes(p.data, into)
        detect_again(into, Config())
        ours, theirs = _our_points(into), _offline_points(into)
        print(f"| {p.name} | {_agreement(ours, theirs):.1f} % | {_agreement(theirs, ours):.1f} % |", flush=True)


Points = dict[tuple[int, str], np.ndarray]  # by number of the later visit, and polarity


def _our_points(data: Path) -> Points:
    found: dict[tuple[int, str], list[np.ndarray]] = {}
    with Store.open_reader(data) as store:
        for change in store.changes.changes():
            found.setdefault((change.visit, change.polarity), []).append(change.points)
    return {key: np.concatenate(points) for key, points in found.items()}


def _offline_points(data: Path) -> Points:
    """What one pass's map has and the pass before has not, and the reverse: no visibility asked, no objects made."""
    with Store.open_reader(data) as store:
        path, sensors, number = store.index.trajectory(), Sensors(store.dir), store.index.latest_visit_numbers()
        visit = np.array([number.get(int(i), 0) for i in path.scan_id])
        maps = {v: _map_of(store, sensors, path.only(visit == v)) for v in range(1, int(visit.max()) + 1)}
    out: Points = {}
    for v in range(2, max(maps) + 1):
        out[v, "appeared"] = _apart(maps[v], maps[v - 1])
        out[v, "disappeared"] = _apart(maps[v - 1], maps[v])
    return out


def _map_of(store: Store, sensors: Sensors, path) -> np.ndarray:
    """Points of some key scans without ground, one for each 10 cm."""
    t = Config().detection
    clouds = [np.empty((0, 3), np.float32)]
    for session, scan_id, T in zip(path.session.tolist(), path.scan_id.tolist(), path.T_map_sensor, strict=True):
        scan = store.scans.read(session, scan_id)
        points = map_points(scan, sensors.get(scan.sensor_digest), 25.0)
        is_ground, _ = ground.segment_ground(points, T[:2, 3], t.ground_sigmas, t.ground_min_sigma_m)
        clouds.append(_thin(points[~is_ground]))
    return _thin(np.concatenate(clouds))


def _thin(points: np.ndarray) -> np.ndarray:
    voxel = np.floor(points / np.float32(THIN_M)).astype(np.int64) + (1 << 20)
    key = (voxel[:, 0] << 42) | (voxel[:, 1] << 21) | voxel[:, 2]
    return points[np.unique(key, return_index=True)[1]]


def _apart(points: np.ndarray, other: np.ndarray) -> np.ndarray:
    return points[np.isinf(cKDTree(other).query(points, distance_upper_bound=OFFLINE_M)[0])]


def _agreement(ours: Points, theirs: Points) -> float:
    """Percent of our points with one of theirs of the same polarity and visit within half a metre."""
    met = [np.isfinite(cKDTree(theirs[key]).query(points, distance_upper_bound=AGREE_M)[0])
           for key, points in ours.items() if key in theirs and len(theirs[key])]  # fmt: skip
    return 100.0 * float(np.concatenate(met).mean()) if met else float("nan")


def plot_sweeps(path: Path, tau: list, alpha: list) -> None:
    """Whole changes and false ones over tau and alpha."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6))
    for ax, rows, paper, name in ((axes[0], tau, TABLE_II, "tau [m]"), (axes[1], alpha, TABLE_III, "alpha [m2]")):
        values = [row[0] for row in rows]
        ax.plot(values, [row[2] for row in rows], "o-", label="whole by surface [%]")
        ax.plot(values, [paper[v][0] for v in values], "o:", color="0.6", label="whole, the paper's [%]")
        ax.set_xlabel(name)
        ax.set_ylim(0, 105)
        false = ax.twinx()
        false.bar(values, [row[3] + row[4] for row in rows], width=0.15 * min(values), color="tab:red", alpha=0.5)
        false.set_ylabel("false changes")
        ax.legend(loc="lower right", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    parser.add_argument("--scenarios", nargs="+", default=["short", "long"])
    parser.add_argument("--folders", type=Path, nargs="+", help="patrols left by patrols.py, in place of seeds")
    parser.add_argument("--tables", type=int, nargs="+", default=[1, 2, 3, 4])
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    if arguments.folders:
        patrols = [Patrol(f.name, f / "data", f / "truth", arguments.work) for f in arguments.folders]
    else:
        patrols = [patrol(arguments.work, name, seed) for name in arguments.scenarios for seed in arguments.seeds]
    tau, alpha = [], []
    for table in arguments.tables:
        print(f"\nTable {('I', 'II', 'III', 'IV')[table - 1]}, patrols: " + ", ".join(p.name for p in patrols))
        if table == 1:
            table_1(patrols)
        elif table == 2:
            tau = sweep(patrols, "tau (m)", TABLE_II, with_tau)
        elif table == 3:
            alpha = sweep(patrols, "alpha (m2)", TABLE_III, with_alpha)
        else:
            table_4(patrols)
    if arguments.plot and tau and alpha:
        plot_sweeps(arguments.plot, tau, alpha)


if __name__ == "__main__":
    main()
