"""What an instance of change detection costs, step by step, against the same steps written plainly.

    python tests/benchmarks/instances.py --data /tmp/patrols/short1_128_RNG19/data [--instances 3] [--repeat 5]

Takes the last instances of a stored patrol (tests/benchmarks/patrols.py leaves one), runs each with the compiled steps
and with those of tests/plain.py, and prints the seconds of every step, and whether both find the same. Then the cost
with other numbers of scans, and the cost of every instance of the patrol, in order: it must not grow with it.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import plain
from rerun import detection_on, instances_of

from revisitd.daemon.comparer import Comparer
from revisitd.daemon.comparison import Comparison, Job
from revisitd.daemon.config import Config
from revisitd.daemon.detection import candidates, detector
from revisitd.daemon.instances import Rejected
from revisitd.storage.store import Store

PLAIN = {
    "revisitd.daemon.submap_build.scan_view": plain.scan_view,
    "revisitd.daemon.detection.submap.Submap.only": plain.only,
    "revisitd.daemon.detection.submap.DepthImage.look_at": plain.look_at,
    "revisitd.daemon.detection.erasure.changed": plain.changed,
    "revisitd.daemon.detection.detector.segment_ground": plain.segment_ground,
    "revisitd.daemon.detection.detector.changed": plain.changed,
    "revisitd.daemon.detection.detector.dense_enough": plain.dense_enough,
}
STEPS = ("load", "update_map", "ground", "neighbours", "noise", "occlusion", "clusters")


@contextmanager
def plainly():
    """Every compiled step replaced by the plain one."""
    with ExitStack() as stack:
        for name, function in PLAIN.items():
            stack.enter_context(mock.patch(name, function))
        yield


def jobs_of(data: Path, config: Config) -> list[Job]:
    """What the detection process is asked for each visit that can be compared, in order."""
    jobs = []
    with Store.open_reader(data) as store:
        detection = detection_on(store, config)
        for instance in instances_of(store):
            with suppress(Rejected):
                jobs.append(detection.job(instance))
    return jobs


def run(comparer: Comparer, job: Job, repeat: int) -> tuple[Comparison, dict[str, float]]:
    """The last result, and the median seconds of each step and of the whole ("all")."""
    results = [comparer.compare(job) for _ in range(repeat)]
    seconds = {step: float(np.median([result.seconds[step] for result in results])) for step in STEPS}
    seconds["all"] = float(np.median([sum(result.seconds.values()) for result in results]))
    return results[-1], seconds


def same_candidates(comparer: Comparer, job: Job) -> bool:
    """Whether both searches give the same points, both ways, of the submaps without their ground."""
    t = job.thresholds
    chosen = [selection.only(selection.chosen) for selection in (job.cumulative, job.recent)]
    submaps = [comparer.load(selection, job.range_m)[0] for selection in chosen]
    old, new = (detector.side_of(submap, t).standing.points for submap in submaps)
    for a, b in ((new, old), (old, new)):
        far = candidates.changed(a, b, t.tau_m, t.n)
        dense = candidates.dense_enough(a[far], t.rho_m, t.n)
        if not np.array_equal(far, plain.changed(a, b, t.tau_m, t.n)):
            return False
        if not np.array_equal(dense, plain.dense_enough(a[far], t.rho_m, t.n)):
            return False
    return True


def against_plain(comparer: Comparer, job: Job, repeat: int) -> None:
    """A table of one instance."""
    ours, seconds = run(comparer, job, repeat)
    with plainly():
        other, plain_seconds = run(comparer, job, 1)
    print(
        f"submaps of {ours.n_points_cumulative / 1e6:.2f} and {ours.n_points_recent / 1e6:.2f} million points, "
        f"{ours.detection.n_candidates} candidates"
    )
    for step in (*STEPS, "all"):
        a, b = seconds[step], plain_seconds[step]
        print(f"  {step:11s} {a:7.3f} s   plain {b:7.3f} s   {b / max(a, 1e-6):6.1f} times")
    sizes = [[len(found.points) for found in result.detection.objects] for result in (ours, other)]
    print(f"  candidates {'identical' if same_candidates(comparer, job) else 'DIFFERENT'}; objects {sizes[0]}, "
          f"plain {sizes[1]}", flush=True)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--instances", type=int, default=3)
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    comparer = Comparer(arguments.data)
    jobs = jobs_of(arguments.data, Config())
    comparer.compare(jobs[-1])  # compiles
    for job in jobs[-arguments.instances :]:
        against_plain(comparer, job, arguments.repeat)
    print("the last instance with k scans:")
    for k in (4, 8, 12, 24, 48):
        job = jobs_of(arguments.data, Config(submaps={"k": k}))[-1]
        result, seconds = run(comparer, job, arguments.repeat)
        n_points = result.n_points_cumulative + result.n_points_recent
        print(f"  k = {k:2d}: {n_points / 1e6:.2f} million points, {seconds['all']:.3f} s")
    print("every instance of the patrol, in order, seconds:")
    print("  " + " ".join(f"{run(comparer, job, 1)[1]['all']:.2f}" for job in jobs))


if __name__ == "__main__":
    main()
