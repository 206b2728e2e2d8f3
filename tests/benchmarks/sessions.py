"""Memory over sessions that join one map: what a month of sensor restarts does, in minutes.

    python tests/benchmarks/sessions.py patrol/capture.pcap --sessions 20 --frames 150 --data /tmp/sessions

The first session takes the whole capture, each other one its first frames again, as after a restart of the sensor.
Prints after each what both processes take, and how many sessions, reference maps and stored places are in memory.
"""

from __future__ import annotations

import argparse
import gc
from itertools import islice
from pathlib import Path

import numpy as np

from revisitd.daemon.config import Config
from revisitd.daemon.memory import resident_bytes
from revisitd.daemon.program import Program
from revisitd.daemon.reference_map import ReferenceMap
from revisitd.daemon.session import Session
from revisitd.drivers.ouster import open_source


def n_alive(kind: type) -> int:
    """How many objects of a type there are, garbage included."""
    return sum(isinstance(thing, kind) for thing in gc.get_objects())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--sessions", type=int, default=20)
    parser.add_argument("--frames", type=int, default=150, help="of each session but the first")
    parser.add_argument("--data", type=Path, required=True)
    arguments = parser.parse_args()
    print("session  joined  main MiB  detection MiB  sessions  reference maps")
    taken = []
    with Program(arguments.data, Config(), arguments.capture, wait=True) as program:
        for i in range(arguments.sessions):
            with open_source(arguments.capture) as frames:
                for frame in islice(frames, None if i == 0 else arguments.frames):
                    program.pipeline.process(frame)
            program.pipeline.finish()
            program.worker.drain()
            mib = [resident_bytes(pid) / 2**20 for pid in ("self", program.process.pid)]
            joined = len(program.pipeline.counts.joined_maps)
            row = f"{i:7d} {joined:7d} {mib[0]:9.0f} {mib[1]:14.0f} {n_alive(Session):9d} {n_alive(ReferenceMap):15d}"
            print(row, flush=True)
            taken.append(mib)
    half = np.array(taken[len(taken) // 2 :])
    slope = np.polyfit(np.arange(len(half)), half, 1)[0]
    print(f"MiB a session over the second half: {slope[0]:+.2f} main, {slope[1]:+.2f} detection")


if __name__ == "__main__":
    main()
