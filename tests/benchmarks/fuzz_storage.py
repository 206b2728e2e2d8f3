"""Thousands of damaged files of the storage: what comes of them, and every hang and foreign exception.

    python tests/benchmarks/fuzz_storage.py [--n 2000] [--seed 0] [scan index changes places identity settings]

The mutants are tests/storage_mutants.py's, the same for the same seed. Exit code 1 where one is not answered by the
storage's own error or a right result; a hang ends the program with its traceback.
"""

from __future__ import annotations

import argparse
import faulthandler
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from storage_mutants import MUTANTS, outcome_of  # noqa: E402

HANG_S = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", default=list(MUTANTS), help="of " + ", ".join(MUTANTS))
    parser.add_argument("--n", type=int, default=2000, help="mutants of each kind")
    parser.add_argument("--seed", type=int, default=0, help="the first one's")
    arguments = parser.parse_args()
    faults = 0
    for what in arguments.what:
        start, outcomes = time.perf_counter(), Counter()
        for seed in range(arguments.seed, arguments.seed + arguments.n):
            faulthandler.dump_traceback_later(HANG_S, exit=True)
            try:
                outcomes[outcome_of(what, seed)] += 1
            except Exception:
                faults += 1
                print(f"{what} {seed}:\n{traceback.format_exc()}")
        faulthandler.cancel_dump_traceback_later()
        counts = ", ".join(f"{count} ({outcome})" for outcome, count in outcomes.most_common())
        print(f"{what}: {arguments.n} mutants in {time.perf_counter() - start:.0f} s: {counts}", flush=True)
    print(f"{faults} faults")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
