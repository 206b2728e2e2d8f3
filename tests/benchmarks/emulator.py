"""What the emulator and the live source cost, and whether they lose anything.

    python tests/benchmarks/emulator.py CAPTURE.pcap [--seconds 20]

Plays a capture, looped, to a kept source in this process, and prints the frames a second, the columns lost and the CPU
time of both processes as a share of one core.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from itertools import islice
from pathlib import Path

import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from emulated import emulated
from fake_sensor import free_port

from revisitd.drivers.gate import FrameGate
from revisitd.drivers.kept import KeptSource
from revisitd.drivers.sensor_setup import SensorWish

WARM_UP_FRAMES = 20  # until both processes have loaded and compiled what they need


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    with emulated(arguments.capture) as sensor:
        source = KeptSource(sensor.address, SensorWish(udp_port_lidar=free_port()), threading.Event())
        frames = (frame for frame in source if frame is not None)
        first = list(islice(frames, WARM_UP_FRAMES))[-1].sensor
        (emulator,) = psutil.Process().children()
        processes = {"emulator": emulator, "live source": psutil.Process()}
        before = {name: _cpu_s(process) for name, process in processes.items()}
        gate, start = FrameGate(), time.monotonic()
        while time.monotonic() - start < arguments.seconds:
            gate.check(next(frames))
        seconds = time.monotonic() - start
        shares = {name: (_cpu_s(process) - before[name]) / seconds for name, process in processes.items()}
        memory = {name: process.memory_info().rss >> 20 for name, process in processes.items()}
    print(f"{first.product} {first.mode} {first.profile}: {gate.accepted / seconds:.2f} frames/s accepted")
    print(f"lost: {gate.losses}")
    for name, share in shares.items():
        print(f"{name}: {100 * share:.0f} % of a core, {memory[name]} MiB")


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


if __name__ == "__main__":
    main()
