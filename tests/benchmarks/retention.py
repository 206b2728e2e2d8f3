"""Writes many times the quota while the housekeeping deletes: does the quota hold, and does the writer feel it?

    python tests/benchmarks/retention.py --quota-gb 0.2 --times 10

Key scans of a virtual robot's size (OS1-128, noise instead of a world: 0.4 MB), in visits to some scenes, with changes.
The size is measured from outside, as `du` does, after each scan. With --rows N, also how long the plan takes in an
index of so many scans (without files), and how long a start.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from stored import SESSION, make_change, make_scan, pose  # noqa: E402

from revisitd.daemon.config import Config, StorageConfig  # noqa: E402
from revisitd.daemon.housekeeping import Housekeeping  # noqa: E402
from revisitd.storage.store import Store  # noqa: E402
from revisitd.storage.usefulness import least_useful  # noqa: E402

VISIT_SCANS, SCENES = 40, 5


def disk_bytes(data: Path) -> int:
    """What all files take, in whole blocks."""
    total = 0
    for path in data.rglob("*"):
        try:
            status = path.stat()
        except FileNotFoundError:  # deleted meanwhile
            continue
        total += status.st_blocks * 512 if path.is_file() else 0
    return total


def write(data: Path, quota_bytes: float, times: float, hz: float) -> tuple[list[float], list[int], dict[str, int]]:
    """Seconds of each scan's storing, sizes from outside, and what is there at the end."""
    config = Config(storage=StorageConfig(quota_gb=quota_bytes / 1e9, min_free_gb=0.0))
    large = make_scan(shape=(128, 1024))
    images = {"range_mm": large.range_mm, "reflectivity": large.reflectivity, "column_ns": large.column_ns}
    images["column_valid"] = large.column_valid
    seconds, sizes, written, visit = [], [], 0, 0
    with Store.open_writer(data) as store, Housekeeping(store, config):
        session = store.index.start_session(**SESSION)
        while written < times * quota_bytes:
            visit += 1
            ids = []
            for i in range(VISIT_SCANS):
                stamp_ns = (visit * 60 + i) * 1_000_000_000
                where = {"stamp_ns": stamp_ns, "T_map_sensor": pose(20.0 * (visit % SCENES) + 0.5 * i)}
                scan = make_scan(store.new_scan_id(), session, **{**images, **where})
                start = time.perf_counter()
                store.add_scan(scan)
                seconds.append(time.perf_counter() - start)
                ids.append(scan.scan_id)
                written += store.scans.path(session, scan.scan_id).stat().st_size
                sizes.append(disk_bytes(data))
                time.sleep(max(0.0, 1.0 / hz - (time.perf_counter() - start)))
            _end_visit(store, session, visit, ids)
        counts = {**store.index.counts(), "changes": len(store.changes.changes(with_points=False))}
    return seconds, sizes, counts


def _end_visit(store: Store, session: int, visit: int, ids: list[int]) -> None:
    scene, number = visit % SCENES + 1, (visit - 1) // SCENES + 1
    first_ns = visit * 60 * 1_000_000_000
    with store.index.transaction():
        if number == 1:
            store.index.add_scene(scene, session, np.zeros((1, 2)), 2.5, 100.0)
        visit_id = store.index.open_visit(scene, number, session, first_ns)
        store.index.add_visit_scans(visit_id, ids)
        store.index.close_visit(visit_id, first_ns + VISIT_SCANS * 1_000_000_000)
    if visit % 4 == 0:
        store.changes.add(make_change(scene=scene, visit=number, session=session, at=(float(visit), 0.0, 0.0)))


def time_plan(data: Path, n_rows: int) -> tuple[float, float, float]:
    """Seconds of a plan, of one step that deletes nothing, and of a start, in an index of so many scans."""
    with Store.open_writer(data) as store:
        session = store.index.start_session(**SESSION)
        for visit in range(1, n_rows // VISIT_SCANS + 1):
            with store.index.transaction():
                ids = [store.new_scan_id() for _ in range(VISIT_SCANS)]
                for i, scan_id in enumerate(ids):
                    store.index.add_scan(make_scan(scan_id, session, (1, 8), T_map_sensor=pose(0.5 * i)), 170_000)
                _end_visit(store, session, visit, ids)
        start = time.perf_counter()
        least_useful(store.dir, 500, 12, 10**9)
        plan_s = time.perf_counter() - start
        keeper = store.retention(quota_bytes=10**15, min_free_bytes=0, kept_per_visit=12, recent_ns=10**9)
        start = time.perf_counter()
        keeper.step()
        step_s = time.perf_counter() - start
    start = time.perf_counter()
    Store.open_writer(data).close()
    return plan_s, step_s, time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quota-gb", type=float, default=0.2)
    parser.add_argument("--times", type=float, default=10.0, help="of the quota, written")
    parser.add_argument("--hz", type=float, default=10.0, help="key scans a second, at most")
    parser.add_argument("--rows", type=int, default=0)
    parser.add_argument("--work", type=Path, help="folder for the data; a temporary one without it")
    arguments = parser.parse_args()
    quota = arguments.quota_gb * 1e9
    with tempfile.TemporaryDirectory(dir=arguments.work) as folder:
        if arguments.rows:
            plan_s, step_s, start_s = time_plan(Path(folder) / "rows", arguments.rows)
            print(f"{arguments.rows} scans: plan {plan_s:.2f} s, step {1e3 * step_s:.1f} ms, start {start_s:.2f} s")
        seconds, sizes, counts = write(Path(folder) / "data", quota, arguments.times, arguments.hz)
    full = sizes[len(sizes) // 2 :]
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    print(f"{arguments.times:g} x {arguments.quota_gb:g} GB written in {len(seconds)} scans")
    print(f"size: at most {max(sizes) / quota:.1%} of the quota, at least {min(full) / quota:.1%} once it was full")
    print(f"a scan takes {p50:.0f} ms to store, {p99:.0f} ms p99, {1e3 * max(seconds):.0f} ms at most")
    print(f"left: {counts['scans']} scans of {counts['visits']} visits; all {counts['changes']} changes")
    sys.exit(max(sizes) > 1.02 * quota)


if __name__ == "__main__":
    main()
