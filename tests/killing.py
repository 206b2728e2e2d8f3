"""A writer that is killed at random instants, and the judge of what it leaves. Used by a test and by a benchmark.

The writer does what the daemon does, as fast as it goes: key scans, visits, changes by the change manager with merges
and ends, retention, the log of places, backups. It prints a line for each thing that it was told is stored; the line
comes after, so whatever a line says must be there.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from stored import SESSION, make_scan, pose

from revisitd.daemon.changes import ChangeManager, Finding
from revisitd.daemon.detection.results import DetectedObject
from revisitd.storage import retention
from revisitd.storage.backup import back_up_if_due
from revisitd.storage.fsck import check
from revisitd.storage.store import Store

VISIT_SCANS = 6
QUOTA_BYTES = 6_000_000  # reached after some kills: scans are deleted from then on
GRID = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 0.1


# The writer ---------------------------------------------------------------------------------------------------------


def write(data: Path, seed: int) -> None:
    """Write until killed; a line of JSON for each thing that is stored."""
    rng, discard = random.Random(seed), retention.discard

    def discard_aloud(index, scans, ids) -> None:
        say(deleting=ids)  # before it is done: whatever is absent without such a line was lost
        discard(index, scans, ids)

    retention.discard = discard_aloud
    with Store.open_writer(data) as store:
        say(opened=True)
        store.dir.put_sensor(SESSION["sensor_digest"], "{}")
        session = store.index.start_session(**SESSION, map_id=1 if store.index.sessions() else None)
        say(session=session)
        keeper = store.retention(quota_bytes=QUOTA_BYTES, min_free_bytes=0, kept_per_visit=VISIT_SCANS, recent_ns=0)
        manager = ChangeManager(store.changes)
        for visit in range(1_000_000):
            add_visit(store, session, scene_id=rng.randint(1, 5), first_ns=visit * 10**10)
            for _ in range(3):
                find(manager, store, session, visit, rng)
            while keeper.step().more:
                pass
            store.log_places()
            back_up_if_due(store.dir, 0.2, kept=2)


def add_visit(store: Store, session: int, scene_id: int, first_ns: int) -> None:
    """Key scans one by one, then their visit, as the pipeline does."""
    ids = []
    for i in range(VISIT_SCANS):
        stamped = {"stamp_ns": first_ns + i, "T_map_sensor": pose(0.5 * i)}
        scan = make_scan(store.new_scan_id(), session, shape=(16, 128), **stamped)
        store.add_scan(scan)
        say(scan=[session, scan.scan_id])
        ids.append(scan.scan_id)
    scenes = {scene.scene_id: scene for scene in store.index.scenes()}
    with store.index.transaction():
        if scene_id not in scenes:
            store.index.add_scene(scene_id, 1, np.zeros((1, 2)), 2.5, 20.0)
        number = scenes[scene_id].n_visits + 1 if scene_id in scenes else 1
        visit_id = store.index.open_visit(scene_id, number, session, first_ns)
        store.index.add_visit_scans(visit_id, ids)
        store.index.close_visit(visit_id, first_ns + VISIT_SCANS)
    say(visit=visit_id, scans=ids)


def find(manager: ChangeManager, store: Store, session: int, visit: int, rng: random.Random) -> None:
    """An object at one of few places, so that it is new, seen again, ends another, or joins two to one."""
    at = np.array([rng.randint(0, 8) * 0.35, 0.0, 0.0])
    polarity = rng.choice(["appeared", "disappeared"])
    times = {"before_ns": visit * 10, "after_ns": visit * 10 + 1 + rng.randint(0, 5)}
    seen = {"n_confirmed": 60, "n_seen_by": 4, "n_confirming": 4, "beyond_tau_m": 0.3}
    found = DetectedObject(polarity, (at + GRID).astype(np.float32), **times, **seen)
    finding = Finding(1, session, 1, visit + 1, 0, session, 0.05, "feedc0ffee00", "abcdef012345")
    with store.changes.transaction():
        manager.record(found, finding)
    known = store.changes.changes(with_points=False)
    say(changes=[[change.id, change.revision] for change in known[-5:]])


def say(**fact: object) -> None:
    print(json.dumps(fact), flush=True)


# The judge ----------------------------------------------------------------------------------------------------------


@dataclass
class Acknowledged:
    """All that the killed writers were told is stored."""

    scans: set[tuple[int, int]] = field(default_factory=set)
    deleting: set[tuple[int, int]] = field(default_factory=set)  # by the retention, perhaps not done yet
    visits: dict[int, list[int]] = field(default_factory=dict)
    revisions: dict[int, int] = field(default_factory=dict)  # the highest that was seen of each change
    sessions: set[int] = field(default_factory=set)

    def take(self, text: str) -> None:
        """Lines of a writer; the last may be torn."""
        for line in text.splitlines(keepends=True):
            if not line.endswith("\n"):
                return
            fact = json.loads(line)
            if "scan" in fact:
                self.scans.add(tuple(fact["scan"]))
            elif "deleting" in fact:
                self.deleting.update(tuple(scan) for scan in fact["deleting"])
            elif "visit" in fact:
                self.visits[fact["visit"]] = fact["scans"]
            elif "session" in fact:
                self.sessions.add(fact["session"])
            for change_id, revision in fact.get("changes", []):
                self.revisions[change_id] = max(revision, self.revisions.get(change_id, 0))


def kill_once(data: Path, seed: int, after_s: float) -> str:
    """A writer that is killed so long after it has opened the directory; what it said."""
    # Forked from a server that has imported all of it: a new interpreter takes seconds to.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killing"])
    with tempfile.NamedTemporaryFile("r") as said:
        writer = context.Process(target=_write_into, args=(said.name, data, seed))
        writer.start()
        until = time.monotonic() + 60.0
        while not os.fstat(said.fileno()).st_size and writer.is_alive() and time.monotonic() < until:
            time.sleep(0.001)
        time.sleep(after_s)
        writer.kill()
        writer.join()
        if writer.exitcode != -signal.SIGKILL:
            raise RuntimeError(f"the writer ended by itself (exit code {writer.exitcode})")
        return said.read()


def _write_into(said: str, data: Path, seed: int) -> None:
    with open(said, "w", encoding="utf-8") as sys.stdout:
        write(data, seed)


def judge(data: Path, acknowledged: Acknowledged) -> tuple[list[str], float]:
    """What is wrong after a kill, and how long the start took, seconds."""
    start = time.perf_counter()
    store = Store.open_writer(data)
    start_s = time.perf_counter() - start
    with store:
        wrong = [f"repaired: {repair}" for repair in store.repairs]
        rows = set(store.index.db.tuples("SELECT session_id, scan_id FROM scans"))
        wrong += [f"scan lost: {scan}" for scan in sorted(acknowledged.scans - rows - acknowledged.deleting)]
        files = set(store.scans.iter_ids())
        wrong += [f"row without file: {scan}" for scan in sorted(rows - files)]
        unacknowledged = rows - acknowledged.scans
        if len(unacknowledged) > 1:  # one may have been stored in the instant before its line
            wrong.append(f"more than was written: {sorted(unacknowledged)}")
        wrong += _wrong_visits(store, acknowledged)
        wrong += _wrong_changes(store, acknowledged)
        leftovers = [*data.glob("*.part"), *(data / "scans" / "tmp").iterdir()]
        wrong += [f"left half-written: {path}" for path in leftovers]
        acknowledged.scans = rows  # what was stored without a line, or was deleted, is known from now on
    # A file whose row did not come to be is no loss, and no half-written scan either: fsck enters it.
    findings = check(data)
    wrong += [line for line in findings.lines() if "that the index does not know" not in line]
    return wrong, start_s


def _wrong_visits(store: Store, acknowledged: Acknowledged) -> list[str]:
    members: dict[int, set[int]] = {}
    for visit_id, scan_id in store.index.db.tuples("SELECT visit_id, scan_id FROM visit_scans"):
        members.setdefault(visit_id, set()).add(scan_id)
    visits = {row[0] for row in store.index.db.tuples("SELECT visit_id FROM visits WHERE t_out_ns IS NOT NULL")}
    left = {scan_id for _, scan_id in store.scans.iter_ids()}
    wrong = [f"visit lost: {visit}" for visit in acknowledged.visits if visit not in visits]
    for visit_id, scans in acknowledged.visits.items():
        if members.get(visit_id, set()) != left & set(scans):
            wrong.append(f"visit {visit_id} is not whole")
    return wrong


def _wrong_changes(store: Store, acknowledged: Acknowledged) -> list[str]:
    now = {change.id: change for change in store.changes.changes()}
    wrong = []
    for change_id, revision in acknowledged.revisions.items():
        whole = store.changes.whole_of(change_id)
        if whole not in now:
            wrong.append(f"change lost: {change_id}")
        elif whole == change_id and now[whole].revision < revision:
            wrong.append(f"change {change_id} fell back")
    for change in now.values():
        if len(change.points) != change.n_points:
            wrong.append(f"change {change.id} is not whole")
        if not store.changes.history(change.id):
            wrong.append(f"change {change.id} has no history")
    return wrong


def kill_many(data: Path, n: int, seed: int, longest_s: float = 1.0) -> tuple[list[str], list[float]]:
    """Kill so many writers on one directory: what was wrong after any, and how long each start took, seconds."""
    rng, acknowledged = random.Random(seed), Acknowledged()
    wrong, starts = [], []
    for i in range(n):
        acknowledged.take(kill_once(data, rng.randrange(2**31), rng.uniform(0.0, longest_s)))
        found, start_s = judge(data, acknowledged)
        wrong += [f"kill {i}: {what}" for what in found]
        starts.append(start_s)
    return wrong, starts
