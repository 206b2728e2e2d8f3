"""How much of a virtual patrol's changes is found, and what is reported beside them.

    python tests/benchmarks/patrols.py --scenario short --seeds 1 2 --work /tmp/patrols

Simulates each patrol into the work folder (kept: a second run replays it only), replays it at full speed, and prints
one line for each: changes found (scoring.py says how), the share of their confirmable surface that is reported, false
changes below and from 125 points, key scans' error against the true poses, median seconds of an instance, frames/s of
the whole replay, and peak memory.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import sqlite3
from pathlib import Path

import numpy as np
from scoring import capture, score

from revisitd.daemon.config import Config, load_config
from revisitd.daemon.replay import replay


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
        patrol = capture(arguments.work, arguments.scenario, seed, arguments.beams, arguments.profile)
        folder = patrol.pcap.parent
        shutil.rmtree(folder / "data", ignore_errors=True)
        summary = replay(str(patrol.pcap), folder / "data", None, config, None, lambda *_: None)
        result = score(folder / "data", patrol.truth)
        with sqlite3.connect(folder / "data" / "index.db") as index:
            seconds = [row[0] for row in index.execute("SELECT seconds FROM instances WHERE status = 'done'")]
            rejected = index.execute("SELECT count(*) FROM instances WHERE status = 'rejected'").fetchone()[0]
        peak_mib = sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
        print(
            f"{folder.name}: found {result.n_found}/{len(result.kinds)}, "
            f"covered {', '.join(f'{share:.0%}' for share in result.by_surface) or '-'}; "
            f"false {result.small} small {result.large} large, duplicates {result.duplicates}; "
            f"trajectory rms {result.rms_m:.3f} max {result.max_m:.3f} m; "
            f"{len(seconds)} instances of {np.median(seconds or [0]):.2f} s, {rejected} rejected, "
            f"{summary.instances_dropped} dropped; {summary.counts.frames / summary.seconds:.1f} frames/s; "
            f"{peak_mib / 1024:.0f} MiB",
            flush=True,
        )


if __name__ == "__main__":
    main()
