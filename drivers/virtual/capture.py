"""A whole patrol of the virtual OS1, written as a capture with its ground truth."""

import os
import pickle
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .packets import PROFILES, Encoder
from .pcap import FILE_HEADER
from .scenarios import SCENARIOS, Scenario
from .sensor import virtual_metadata
from .truth import Truth
from .worker import Job, Shot, run
from .worlds import World, build_world

QUEUED_SHOTS = 16


@dataclass(frozen=True)
class Capture:
    """Paths of a simulated capture."""

    pcap: Path
    metadata: Path
    truth: Path  # the folder with poses.txt, changes.json, objects.json, labels.npz


def simulate(
    out_dir: Path,
    scenario: str | Scenario = "short",
    seed: int = 0,
    beams: int = 128,
    columns: int = 1024,
    rate_hz: int = 10,
    profile: str = PROFILES[0],
    passes: int | None = None,
    length_m: float | None = None,
    max_s: float | None = None,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Drives a patrol and writes capture.pcap, capture.json and truth/ into out_dir.

    scenario: a name of SCENARIOS, or one of your own; passes and length_m (of the route) override it; max_s
    cuts the patrol short. workers: processes that cast; the bytes written do not depend on it. progress: called
    with (frames done, frames in all). Raises ValueError for unknown names and for sensors that do not exist.
    """
    plan = _plan(scenario, passes, length_m)
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}; known: {', '.join(PROFILES)}")
    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    metadata = virtual_metadata(beams, columns, rate_hz, profile)
    capture = Capture(out_dir / "capture.pcap", out_dir / "capture.json", out_dir / "truth")
    capture.metadata.write_text(metadata)
    world = build_world(plan, seed)
    total = max(1, int(min(world.patrol.duration_s, max_s or np.inf) * 1e9) // Encoder(metadata).period_ns)
    jobs = _jobs(Job(plan, seed, metadata, 0, total, capture.pcap), workers)
    truth = Truth(capture.truth, world)
    try:
        for done, shot in enumerate(_shots(jobs, world), 1):
            truth.add(shot)
            if progress:
                progress(done, total)
        truth.write()
        _join([job.part for job in jobs], capture.pcap)
    finally:
        for job in jobs:
            job.part.unlink(missing_ok=True)
    return capture


def _plan(scenario: str | Scenario, passes: int | None, length_m: float | None) -> Scenario:
    if isinstance(scenario, str):
        if scenario not in SCENARIOS:
            raise ValueError(f"unknown scenario {scenario!r}; known: {', '.join(SCENARIOS)}")
        scenario = SCENARIOS[scenario]
    if passes:
        scenario = replace(scenario, passes=passes)
    return replace(scenario, length_m=(length_m, length_m)) if length_m else scenario


def _jobs(whole: Job, count: int) -> list[Job]:
    """One job cut into at most `count`, each with a part of its own."""
    bounds = [whole.stop * k // count for k in range(count + 1)]
    return [
        replace(whole, first=first, stop=stop, part=whole.part.with_suffix(f".part{k}"))
        for k, (first, stop) in enumerate(zip(bounds[:-1], bounds[1:], strict=True))
        if first < stop
    ]


def _shots(jobs: list[Job], world: World) -> Iterator[Shot]:
    """The Shots of all jobs as they come; a single job runs in this process."""
    if len(jobs) == 1:
        yield from run(jobs[0], world)
        return
    arrived: queue.Queue = queue.Queue(QUEUED_SHOTS)
    processes = [_start(job) for job in jobs]
    try:
        for k, process in enumerate(processes):
            threading.Thread(target=_forward, args=(process, arrived), name=f"virtual-os1-{k}", daemon=True).start()
        running = len(processes)
        while running:
            message = arrived.get()
            if isinstance(message, Exception):
                raise message
            if message is None:
                running -= 1
            else:
                yield message
    finally:
        for process in processes:
            process.kill()
            process.wait()
            process.stdout.close()


def _start(job: Job) -> subprocess.Popen:
    # A plain process rather than multiprocessing: it needs neither a fork beside running threads nor an
    # importable __main__, so that simulate() also works from a notebook or a script without a guard.
    command = [sys.executable, "-c", f"from {__package__}.worker import main; main()"]
    # Small matrix products: more threads of BLAS than processes only wait for each other.
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=alone)
    with process.stdin:
        pickle.dump(job, process.stdin)
    return process


def _forward(process: subprocess.Popen, arrived: queue.Queue) -> None:
    try:
        message = pickle.load(process.stdout)
        while isinstance(message, Shot):
            arrived.put(message)
            message = pickle.load(process.stdout)
        arrived.put(message)
    except Exception as error:  # whatever it is, the reader waits for it
        arrived.put(RuntimeError(f"a process of the simulation died: {error!r}"))


def _join(parts: list[Path], target: Path) -> None:
    """The parts' records as one pcap."""
    with open(target, "wb") as out:
        out.write(FILE_HEADER)
        for part in parts:
            with open(part, "rb") as source:
                shutil.copyfileobj(source, out, 1 << 20)
