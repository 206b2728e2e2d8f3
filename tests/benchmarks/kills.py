"""Kills a writer at random instants, many times, and looks after each what is there.

    python tests/benchmarks/kills.py --n 200 --seed 1

After each kill the directory is opened, timed, and compared with all that was acknowledged so far and with fsck: see
tests/killing.py.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from killing import kill_many  # noqa: E402

from revisitd.storage.store import Store  # noqa: E402

MAX_START_S = 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n", type=int, default=200, help="kills")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        wrong, starts = kill_many(data, arguments.n, arguments.seed)
        with Store.open_reader(data) as store:
            counts = store.index.counts()
            n_changes = len(store.changes.changes(with_points=False))
    print(f"{arguments.n} kills, {len(wrong)} faults; start {np.median(starts):.2f} s, at most {max(starts):.2f} s")
    print(f"at the end {counts['scans']} scans, {counts['visits']} visits, {n_changes} changes")
    for what in wrong:
        print(what)
    sys.exit(bool(wrong) or max(starts) > MAX_START_S)


if __name__ == "__main__":
    main()
