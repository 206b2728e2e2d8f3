"""Thousands of damaged inputs for the drivers: what comes of them, and every crash, hang and foreign exception.

    python tests/benchmarks/fuzz.py [--n 2000] [--seed 0] [packets pcap metadata osf http]

The inputs are tests/mutants.py's, the same for the same seed. They are read in a process of their own, which is
started again after one that kills it; such a seed is named. Exit code 1 where there is any.
"""

from __future__ import annotations

import argparse
import faulthandler
import subprocess
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from mutants import MUTANTS, outcome_of

HANG_S = 30


def try_all(what: str, first: int, end: int) -> None:
    """Prints the outcome of each seed; a hang ends the process."""
    for seed in range(first, end):
        faulthandler.dump_traceback_later(HANG_S, exit=True)
        try:
            outcome = outcome_of(what, seed)
        except Exception as error:
            traceback.print_exc()
            outcome = f"BUG {type(error).__name__}"
        print(outcome, flush=True)


def outcomes_of(what: str, first: int, end: int) -> list[str]:
    """The outcome of each seed, tried in processes of their own."""
    outcomes: list[str] = []
    while first + len(outcomes) < end:
        command = [sys.executable, __file__, "--worker", what, str(first + len(outcomes)), str(end)]
        run = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        outcomes += run.stdout.splitlines()
        if run.returncode:
            outcomes.append(f"BUG exit code {run.returncode}")
    return outcomes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=list(MUTANTS), help="of " + ", ".join(MUTANTS))
    parser.add_argument("--n", type=int, default=2000, help="inputs of each kind")
    parser.add_argument("--seed", type=int, default=0, help="the first one's")
    arguments = parser.parse_args()
    bugs = 0
    for what in arguments.what:
        start = time.perf_counter()
        outcomes = outcomes_of(what, arguments.seed, arguments.seed + arguments.n)
        seconds = time.perf_counter() - start
        counts = ", ".join(f"{count} {outcome}" for outcome, count in Counter(outcomes).most_common())
        print(f"{what:9s} {len(outcomes)} inputs in {seconds:.0f} s: {counts}", flush=True)
        for seed, outcome in enumerate(outcomes, arguments.seed):
            if outcome.startswith("BUG"):
                bugs += 1
                print(f"    seed {seed}: {outcome}")
    sys.exit(bool(bugs))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        try_all(sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
    else:
        main()
