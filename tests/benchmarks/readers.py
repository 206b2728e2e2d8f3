"""One writer at full rate and many readers that poll changes.db: errors and delays of either side.

    python tests/benchmarks/readers.py --seconds 120 --readers 20

The writer stores key scans as fast as the frame rate asks (10 Hz, more than any robot keeps) and changes, with merges;
the readers are processes that open changes.db with `mode=ro`, as other programs do, and apply the feed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sqlite3
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stored import SESSION, make_change, make_scan  # noqa: E402

from revisitd.storage.store import Store  # noqa: E402

PERIOD_S = 0.1
POLL_S = 0.02
LOCK_S = 0.05  # that a reader waits for a lock: far less than sqlite3's usual 5 s


def poll(path: Path, seconds: float, outcome: multiprocessing.Queue) -> None:
    """A program that waits for changes: its copy of them, by the feed alone; errors, polls and the slowest one."""
    db = sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=LOCK_S)
    copy, revision, polls, slowest, errors = {}, 0, 0, 0.0, []
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        start = time.perf_counter()
        try:
            feed = "SELECT revision, event, id FROM change_feed WHERE revision > ? ORDER BY revision"
            for new, event, change_id in db.execute(feed, (revision,)).fetchall():
                if new <= revision:
                    errors.append(f"revision {new} after {revision}")
                revision = new
                if event == "merged":
                    copy.pop(change_id, None)
                else:
                    copy[change_id] = new
        except sqlite3.Error as error:
            errors.append(str(error))
        slowest, polls = max(slowest, time.perf_counter() - start), polls + 1
        time.sleep(POLL_S)
    # What the feed brought must be what the table holds, up to the same revision.
    db.execute("BEGIN")
    for new, event, change_id in db.execute(
        "SELECT revision, event, id FROM change_feed WHERE revision > ?", (revision,)
    ):
        copy.pop(change_id, None) if event == "merged" else copy.update({change_id: new})
    if copy != dict(db.execute("SELECT id, revision FROM changes")):
        errors.append("the copy differs from the table")
    outcome.put((errors, polls, slowest))


def write(store: Store, seconds: float) -> tuple[list[float], list[float]]:
    """Scans and changes until the time is over; how long each took, seconds."""
    session = store.index.start_session(**SESSION)
    scan_s, change_s, known = [], [], []
    begun = time.monotonic()
    while time.monotonic() - begun < seconds:
        start = time.perf_counter()
        store.add_scan(make_scan(store.new_scan_id(), session, shape=(64, 512)))
        scan_s.append(time.perf_counter() - start)
        start = time.perf_counter()
        known.append(store.changes.add(make_change(at=(float(len(change_s)), 0.0, 0.0), n_points=500)))
        if len(change_s) % 5 == 4:
            store.changes.merge(known.pop(), known[-1])
        change_s.append(time.perf_counter() - start)
        time.sleep(max(0.0, begun + len(scan_s) * PERIOD_S - time.monotonic()))
    return scan_s, change_s


def measure(data: Path, seconds: float, n_readers: int) -> tuple[list[str], int, float, list[float], list[float]]:
    """Errors and polls of all readers, their slowest poll, and the writer's times, seconds."""
    context = multiprocessing.get_context("spawn")
    with Store.open_writer(data) as store:
        outcome = context.Queue()
        readers = [
            context.Process(target=poll, args=(store.dir.changes_path, seconds, outcome)) for _ in range(n_readers)
        ]
        for reader in readers:
            reader.start()
        scan_s, change_s = write(store, seconds)
        outcomes = [outcome.get(timeout=60.0) for _ in readers]
        for reader in readers:
            reader.join()
    errors = [error for found, _, _ in outcomes for error in found]
    return errors, sum(polls for _, polls, _ in outcomes), max(slow for _, _, slow in outcomes), scan_s, change_s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--readers", type=int, default=20)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        errors, polls, slowest, scan_s, change_s = measure(Path(folder), arguments.seconds, arguments.readers)
    print(f"{arguments.readers} readers: {polls} polls, {len(errors)} errors, the slowest {1e3 * slowest:.0f} ms")
    for name, times in (("scans", scan_s), ("changes", change_s)):
        p50, p99 = np.percentile(times, (50, 99)) * 1e3
        print(f"writer: {len(times)} {name}, {p50:.1f} ms median, {p99:.1f} ms p99, {1e3 * max(times):.1f} ms at most")
    for error in sorted(set(errors)):
        print(error)
    sys.exit(bool(errors))


if __name__ == "__main__":
    main()
