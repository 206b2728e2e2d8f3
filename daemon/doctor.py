"""Looks whether all that revisitd needs is there: each finding ok, warn or fail, with what mends it."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ..drivers.errors import DriverError
from ..drivers.metadata import parse_metadata, sensor_from_info
from ..drivers.sensor_http import SensorHttp, host_of, resolve
from ..drivers.telemetry import read_telemetry
from ..storage.errors import StorageError
from .config import Config
from .status import NotRunning, read_status

WANTED_RMEM_BYTES = 4 << 20
MIN_CORES = 2
MIN_MEMORY_BYTES = 2 << 30
LISTEN_S = 2.0


@dataclass(frozen=True)
class Finding:
    """One thing looked at."""

    subject: str
    verdict: str  # ok | warn | fail
    found: str
    mend: str = ""  # what to do, a command where there is one


def examine(address: str, data: Path, config: Config) -> Iterator[Finding]:
    """All findings, one after another: some take seconds. address: of the sensor; "" looks at this machine alone."""
    yield from _machine()
    yield from _guarded("model", _model)
    yield from _guarded("data", lambda: _data(data, config))
    yield _service(data)
    if address:
        yield from _guarded("sensor", lambda: _sensor(address))


def _guarded(subject: str, look: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """An error on the way is a finding too."""
    try:
        yield from look()
    except (DriverError, StorageError, OSError) as error:
        yield Finding(subject, "fail", str(error))


def _machine() -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0))
    verdict = "ok" if cores >= MIN_CORES else "warn"
    yield Finding("cores", verdict, f"{cores} to use", "" if verdict == "ok" else "OS1 at 10 Hz needs two")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    verdict = "ok" if memory >= MIN_MEMORY_BYTES else "warn"
    yield Finding("memory", verdict, f"{memory / 2**30:.1f} GiB", "" if verdict == "ok" else "1 GiB is revisitd's own")
    rmem = int(Path("/proc/sys/net/core/rmem_max").read_text())
    if rmem >= WANTED_RMEM_BYTES:
        yield Finding("receive buffer", "ok", f"net.core.rmem_max is {rmem}")
    else:
        mend = f"sudo sysctl -w net.core.rmem_max={WANTED_RMEM_BYTES}   (install-service makes it last)"
        yield Finding("receive buffer", "warn", f"net.core.rmem_max is {rmem}: packets are lost when busy", mend)


def _model() -> Iterator[Finding]:
    from ..models.descriptor import DescriptorModel, ModelError

    try:
        model = DescriptorModel.load()
    except ModelError as error:
        yield Finding("model", "fail", str(error), "install revisitd again")
    else:
        yield Finding("model", "ok", f"descriptor {model.model_id}")


def _data(data: Path, config: Config) -> Iterator[Finding]:
    from ..storage.store import Store

    place = data
    while not place.exists():
        place = place.parent
    if not os.access(place, os.W_OK | os.X_OK):
        yield Finding("data", "fail", f"{place} cannot be written by this user", f"sudo chown -R $USER {place}")
    if data.exists() and any(data.iterdir()):
        with Store.open_reader(data) as store:
            counts = store.index.counts()
        yield Finding("data", "ok", f"{data}: {counts['scans']} scans, {counts['scenes']} scenes")
    else:
        yield Finding("data", "ok", f"{data}: new")
    free, wanted = shutil.disk_usage(place).free, config.storage.min_free_gb * 1e9
    verdict = "ok" if free > wanted else "fail"
    mend = "" if verdict == "ok" else "free some space, or lower storage.min_free_gb"
    yield Finding("disk", verdict, f"{free / 1e9:.1f} GB free, {wanted / 1e9:.1f} GB are to stay free", mend)


def _service(data: Path) -> Finding:
    try:
        status = read_status(data if data.exists() else None)
    except NotRunning as why:
        return Finding("service", "ok", str(why))
    verdict = "ok" if status["state"] == "running" else "warn"
    return Finding("service", verdict, f"runs, pid {status['pid']}: {status['line']}")


def _sensor(address: str) -> Iterator[Finding]:
    sensor = SensorHttp(address)
    metadata = sensor.metadata()
    info, config = metadata["sensor_info"], metadata["config_params"]
    yield Finding("sensor", "ok", f"{info.get('prod_line')} {info.get('prod_sn')}, {info.get('image_rev')}")
    status = info.get("status")
    yield Finding(
        "sensor status",
        "ok" if status == "RUNNING" else "warn",
        str(status),
        "" if status == "RUNNING" else "`revisitd run` switches it on; ERROR: look at its alerts page",
    )
    yield _destination(address, config)
    yield from _health(sensor, config)
    yield from _packets(address, metadata)


def _destination(address: str, config: dict) -> Finding:
    ours, theirs = resolve(address)[1], config.get("udp_dest", "")
    if theirs == ours:
        return Finding("destination", "ok", f"it sends to this machine, {ours}")
    return Finding(
        "destination", "warn", f"it sends to {theirs or 'nobody'}, not to this machine ({ours})",
        "`revisitd run` sets it; another program that reads the sensor would lose its packets",
    )  # fmt: skip


def _health(sensor: SensorHttp, config: dict) -> Iterator[Finding]:
    """What the sensor says of its clock and its alerts."""
    telemetry, mode = read_telemetry(sensor), config.get("timestamp_mode", "")
    if telemetry.clock_synced is False:
        yield Finding("sensor clock", "warn", f"{mode}: not synchronised", "start its PTP master or its sync pulse")
    elif mode == "TIME_FROM_INTERNAL_OSC":
        yield Finding("sensor clock", "ok", f"{mode}: counts from its power-up; times of day are this machine's")
    else:
        yield Finding("sensor clock", "ok", mode)
    for alert in telemetry.alerts:
        yield Finding("sensor alert", "warn", alert, "see the sensor's web page")


def _packets(address: str, metadata: dict) -> Iterator[Finding]:
    """Listens for a moment, if nobody does yet."""
    sensor = sensor_from_info(parse_metadata(json.dumps(metadata)), json.dumps(metadata))
    yield Finding("packets", "ok", f"{sensor.mode}, {sensor.profile}")
    port = int(metadata["config_params"]["udp_port_lidar"])
    family = socket.AF_INET6 if ":" in host_of(address) else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as listener:
        try:
            listener.bind(("", port))
        except OSError:
            yield Finding("reception", "ok", f"UDP port {port} is in use: revisitd or another program listens there")
            return
        listener.settimeout(0.1)
        n_packets, end = 0, time.monotonic() + LISTEN_S
        while time.monotonic() < end:
            try:
                listener.recv(65536)
                n_packets += 1
            except TimeoutError:
                continue
    if n_packets:
        yield Finding("reception", "ok", f"{n_packets / LISTEN_S:.0f} packets/s at UDP port {port}")
    else:
        mend = f"see `destination`; a firewall: sudo ufw allow {port}/udp"
        yield Finding("reception", "warn", f"no packet at UDP port {port} within {LISTEN_S:g} s", mend)
