"""The daemon against an emulated sensor for an hour, with faults at random; a report and a plot.

    python tests/benchmarks/soak.py --minutes 60 --work /tmp/soak

The sensor is `revisitd emulate --loop` of a virtual patrol (made if --capture names none), the daemon is `revisitd
run`, restarted as systemd would when it is killed. Faults: lost and corrupt packets, silence, reboots and clock steps
of the sensor, HTTP errors, kill -9 of the daemon. Each few seconds its status is noted.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np

from revisitd.daemon.status import NotRunning, read_status
from revisitd.drivers import virtual

EVERY_S = 5.0
HTTP_PORT = 8095
WARM_UP_S = 300.0  # after a start: imports, compiled loops, caches
RESTART_S = 5.0  # as the unit's RestartSec
PROGRAM = "from revisitd.daemon.cli import main\nif __name__ == '__main__':\n    main()\n"
# What happens, how often an hour, and what the emulator is told; None: the daemon is killed.
FAULTS = {
    "packets lost": (12, {"drop": 0.05}),
    "packets corrupt": (6, {"corrupt": 0.02}),
    "silence of 8 s": (6, {"silence_s": 8.0}),
    "sensor reboots": (4, {"reboot_s": 6.0}),
    "clock steps": (2, {"step_s": 37.0}),
    "HTTP answers errors": (4, {"http": "error"}),
    "kill -9": (4, None),
}
LASTS_S = 10.0  # a fault that has to be ended
NO_FAULT = {"drop": 0.0, "corrupt": 0.0, "http": "none"}


class Soak:
    """The processes, the faults, and what was seen."""

    def __init__(self, work: Path, capture: Path, quota_gb: float, seed: int):
        self._work, self._data = work, work / "data"
        self._program = work / "program.py"
        self._program.write_text(PROGRAM)
        self._settings = work / "soak.toml"
        address = f"127.0.0.1:{HTTP_PORT}"
        self._settings.write_text(f'[sensor]\naddress = "{address}"\n[storage]\nquota_gb = {quota_gb}\n')
        self._url = f"http://{address}/emulator/faults"
        self._random = random.Random(seed)
        self._emulator = self._start("emulator.log", "emulate", capture, "--loop", "--http-port", HTTP_PORT)
        self._daemon = self._start_daemon()
        self.samples: list[dict] = []
        self.faults: list[tuple[float, str]] = []
        self.restarts = 0
        self._begun = time.monotonic()

    def run(self, seconds: float) -> None:
        """Until the time is over."""
        due = self._schedule(seconds)
        heal_at = np.inf
        while (now := time.monotonic() - self._begun) < seconds:
            if now >= heal_at and self._tell(NO_FAULT):
                heal_at = np.inf
            if due and now >= due[0][0] and self._cause(due[0][1]):
                due.pop(0)
                heal_at = now + LASTS_S
            if self._daemon.poll() is not None:
                time.sleep(RESTART_S)
                self._daemon = self._start_daemon()
                self.restarts += 1
            self._sample(now)
            time.sleep(EVERY_S)

    def close(self) -> int:
        """Stop the daemon in order and the emulator; the daemon's exit code."""
        self._daemon.send_signal(signal.SIGTERM)
        code = self._daemon.wait(60)
        self._emulator.kill()
        self._emulator.wait()
        return code

    def fsck(self) -> str:
        """What `revisitd fsck` says of the store afterwards."""
        command = [sys.executable, self._program, "fsck", self._data]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        return f"exit code {result.returncode}: {(result.stdout + result.stderr).strip()}"

    def _schedule(self, seconds: float) -> list[tuple[float, str]]:
        due = []
        for name, (per_hour, _) in FAULTS.items():
            for _ in range(max(1, round(per_hour * seconds / 3600))):
                due.append((self._random.uniform(20.0, seconds - 20.0), name))
        return sorted(due)

    def _cause(self, name: str) -> bool:
        """False where the sensor is away, rebooting: later."""
        told = FAULTS[name][1]
        if told is None:
            self._daemon.kill()
            self._daemon.wait()
        elif not self._tell(told):
            return False
        self.faults.append((time.monotonic() - self._begun, name))
        return True

    def _tell(self, fault: dict) -> bool:
        request = urllib.request.Request(self._url, data=json.dumps(fault).encode())
        try:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=10):
                return True
        except urllib.error.HTTPError:
            raise
        except urllib.error.URLError:
            return False

    def _sample(self, now: float) -> None:
        try:
            self.samples.append({"t_s": now, **read_status(self._data)})
        except NotRunning:
            pass

    def _start_daemon(self) -> subprocess.Popen:
        return self._start("daemon.log", "run", "--config", self._settings, "--data", self._data)

    def _start(self, log: str, *arguments: object) -> subprocess.Popen:
        with (self._work / log).open("ab") as out:
            return subprocess.Popen([sys.executable, self._program, *map(str, arguments)], stdout=out, stderr=out)


def slope_within_runs(samples: list[dict], t_h: np.ndarray, mib: np.ndarray) -> float:
    """MiB an hour that all runs of the daemon have in common, each without its first minutes; NaN for short ones."""
    pid = np.array([sample["pid"] for sample in samples])
    along = above = 0.0
    for run in np.unique(pid):
        t, m = t_h[pid == run], mib[pid == run]
        warm = t > t[0] + WARM_UP_S / 3600
        if warm.any():
            t, m = t[warm] - t[warm].mean(), m[warm] - m[warm].mean()
            along, above = along + t @ t, above + t @ m
    return above / along if along else float("nan")


def over_restarts(samples: list[dict], counts: list[int]) -> np.ndarray:
    """A counter that each run of the daemon begins at zero, as one that goes on."""
    steps = np.diff(counts, prepend=0)
    begun = np.diff([sample["pid"] for sample in samples], prepend=0) != 0
    return np.cumsum(np.where(begun, counts, steps))


def report(soak: Soak, quota_gb: float) -> str:
    """The figures, for people."""
    samples = soak.samples
    t_h = np.array([sample["t_s"] for sample in samples]) / 3600
    lines = [f"{t_h[-1] * 60:.0f} minutes, {len(soak.faults)} faults, {soak.restarts} restarts"]
    for name in ("memory_bytes", "detection_memory_bytes"):
        mib = np.array([sample["store"][name] for sample in samples]) / 2**20
        slope = slope_within_runs(samples, t_h, mib)
        lines.append(f"{name}: median {np.median(mib):.0f} MiB, most {mib.max():.0f} MiB, slope {slope:+.1f} MiB/h")
    used = np.array([sample["store"]["used_bytes"] for sample in samples]) / 1e9
    lines.append(f"disk: most {used.max():.3f} GB of {quota_gb:g} GB; {samples[-1]['store']['scans']} scans at the end")
    hz = np.array([sample["frames"]["hz"] for sample in samples if sample["sensor"]["phase"] == "running"])
    lines.append(f"frames: median {np.median(hz):.1f} Hz while the sensor runs")
    runs: dict[int, dict] = {sample["pid"]: sample for sample in samples}  # the last of each
    totals = {name: sum(last["detection"][name] for last in runs.values()) for name in ("done", "failed", "dropped")}
    losses: dict[str, int] = {}
    for last in runs.values():
        for cause, count in last["frames"]["losses"].items():
            losses[cause] = losses.get(cause, 0) + count
    lines.append(
        f"frames {sum(last['frames']['received'] for last in runs.values())}, "
        f"key scans {sum(last['place']['key_scans'] for last in runs.values())}, "
        f"not stored {sum(last['frames']['not_stored'] for last in runs.values())}, "
        f"joined {sum(len(last['place']['joined_maps']) for last in runs.values())} times"
    )
    lines.append("instances: " + ", ".join(f"{count} {name}" for name, count in totals.items()))
    lines.append("lost: " + ", ".join(f"{count} x {cause}" for cause, count in losses.items()))
    return "\n".join(lines)


def plot(soak: Soak, path: Path) -> None:
    """Memory, disk, instances and losses, frame rate, faults and restarts over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    t_min = [sample["t_s"] / 60 for sample in soak.samples]
    figure, axes = pyplot.subplots(4, 1, figsize=(10, 10), sharex=True, layout="constrained")
    for name, label in (("memory_bytes", "main process"), ("detection_memory_bytes", "detection process")):
        axes[0].plot(t_min, [sample["store"][name] / 2**20 for sample in soak.samples], label=label)
    axes[0].set_ylabel("memory, MiB")
    axes[1].plot(t_min, [sample["store"]["used_bytes"] / 1e9 for sample in soak.samples], label="data directory")
    axes[1].plot(t_min, [sample["store"]["quota_bytes"] / 1e9 for sample in soak.samples], "--", label="quota")
    axes[1].set_ylabel("disk, GB")
    done = [sample["detection"]["done"] for sample in soak.samples]
    axes[2].plot(t_min, over_restarts(soak.samples, done), label="instances done")
    lost = [sample["frames"]["losses"].get("frames missing", 0) for sample in soak.samples]
    axes[2].plot(t_min, over_restarts(soak.samples, lost), label="frames missing")
    axes[2].set_ylabel("since the start")
    axes[3].plot(t_min, [sample["frames"]["hz"] for sample in soak.samples], label="frames, Hz")
    for at_s, name in soak.faults:
        axes[3].axvline(at_s / 60, color="tab:red", alpha=0.3, lw=1)
        axes[3].text(at_s / 60, 0.2, name, rotation=90, fontsize=6, va="bottom")
    axes[3].set(ylabel="frame rate, Hz", xlabel="minutes")
    for axis in axes:
        axis.legend(loc="upper right")
        axis.set_ylim(bottom=0)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--work", type=Path, required=True, help="folder for everything, also the report")
    parser.add_argument("--capture", type=Path, help="a pcap with its metadata beside it; a virtual patrol without it")
    parser.add_argument("--beams", type=int, default=64, help="of the virtual sensor")
    parser.add_argument("--columns", type=int, default=1024)
    parser.add_argument("--quota-gb", type=float, default=0.3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True)
    capture = arguments.capture
    if capture is None:
        patrol = {"scenario": "demo", "seed": arguments.seed, "profile": "RNG15_RFL8_NIR8"}
        size = {"beams": arguments.beams, "columns": arguments.columns}
        capture = virtual.simulate(arguments.work / "patrol", **patrol, **size).pcap
    soak = Soak(arguments.work, capture, arguments.quota_gb, arguments.seed)
    try:
        soak.run(60 * arguments.minutes)
    finally:
        code = soak.close()
    text = f"{report(soak, arguments.quota_gb)}\nstopped with exit code {code}; fsck: {soak.fsck()}"
    (arguments.work / "report.txt").write_text(text + "\n")
    (arguments.work / "samples.json").write_text(json.dumps(soak.samples))
    plot(soak, arguments.work / "soak.png")
    print(text)


if __name__ == "__main__":
    main()
