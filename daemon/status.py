"""What the running service says of itself: a small JSON file, for people, programs and Prometheus.

In $RUNTIME_DIRECTORY (memory, /run/revisitd) under systemd, else in the data directory.
"""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass
from pathlib import Path

FILE = "status.json"
RUN_DIR = Path("/run/revisitd")
STALE_S = 15.0  # it is written each second


class NotRunning(Exception):
    """No service writes this status now; the message says since when."""


@dataclass(frozen=True)
class SensorStatus:
    """The sensor, as far as it is known."""

    address: str
    phase: str  # connecting | running | silent | ...
    problem: str  # what keeps it from running, and what to do; empty where nothing does
    since_host_ns: int  # of this phase
    times_opened: int
    serial: str = ""
    product: str = ""
    firmware: str = ""
    profile: str = ""
    mode: str = ""
    clock: str = ""  # what it follows
    clock_synced: bool | None = None  # None: it follows nothing, or does not say
    temperature_c: float | None = None
    alerts: tuple[str, ...] = ()


@dataclass(frozen=True)
class FrameStatus:
    """Frames since the start."""

    hz: float  # over the last seconds
    received: int
    rejected: int
    not_stored: int  # key scans that the disk did not take
    lost_share: float  # of the columns that were to come, over the last seconds
    losses: dict[str, int]  # by cause: packets, columns, frames


@dataclass(frozen=True)
class PlaceStatus:
    """Where the robot is, by its odometry and the map."""

    odometry: str  # good, or why it is lost; empty before the first frame
    times_lost: int
    session_id: int | None
    map_id: int | None
    scenes: tuple[int, ...]
    key_scans: int  # of this run
    joined_maps: tuple[int, ...]


@dataclass(frozen=True)
class DetectionStatus:
    """Instances of change detection since the start."""

    busy_s: float  # the instance at hand; 0: none
    waiting: int
    done: int
    failed: int
    dropped: int
    new_changes: int
    present_changes: int  # in the store, of all runs


@dataclass(frozen=True)
class StoreStatus:
    """Disk and memory."""

    data: str
    used_bytes: int
    quota_bytes: int
    free_bytes: int
    scans: int
    scans_deleted: int  # by retention, since the start
    problem: str  # why key scans are not stored, or the quota is not kept; empty where all is well
    repairs: tuple[str, ...]  # what opening the store had to put right
    memory_bytes: int  # resident, of this process
    detection_memory_bytes: int  # resident, of the detection process


@dataclass(frozen=True)
class Status:
    """All of it, at one moment."""

    state: str  # one word: running | waiting | lost | degraded
    line: str  # one line for people
    version: str
    pid: int
    started_host_ns: int
    updated_host_ns: int
    model_id: str
    settings: str  # digest of all values
    sensor: SensorStatus
    frames: FrameStatus
    place: PlaceStatus
    detection: DetectionStatus
    store: StoreStatus


def status_path(data: Path) -> Path:
    """Where the service of a data directory writes its status."""
    return Path(os.environ.get("RUNTIME_DIRECTORY", data)) / FILE


def write_status(path: Path, status: Status) -> None:
    """Replace the file at once. Raises OSError."""
    unfinished = path.with_name(f".{FILE}.tmp")
    unfinished.write_text(json.dumps(asdict(status), indent=1) + "\n", encoding="utf-8")
    unfinished.replace(path)


def read_status(data: Path | None) -> dict:
    """The status of the service of a data directory, or of the system's; raises NotRunning."""
    for path in (data / FILE, RUN_DIR / FILE) if data else (RUN_DIR / FILE,):
        try:
            status = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise NotRunning(f"{path} cannot be read: {error}") from error
        if data and Path(status["store"]["data"]).resolve() != data.resolve():
            continue
        age_s = (time.time_ns() - status["updated_host_ns"]) * 1e-9
        if age_s > STALE_S:
            raise NotRunning(f"revisitd does not run here: {path} was last written {_duration(age_s)} ago")
        return status
    raise NotRunning(f"revisitd does not run {f'for {data}' if data else 'as a service'}: there is no status of it")


def status_table(status: dict) -> str:
    """For people: one subject a line. Raises NotRunning for a status that another version of revisitd writes."""
    try:
        return _table(status)
    except KeyError as missing:
        raise NotRunning(f"another version of revisitd runs, its status has no {missing}: restart it") from None


def _table(status: dict) -> str:
    sensor, frames, place = status["sensor"], status["frames"], status["place"]
    detection, store = status["detection"], status["store"]
    up_s = (status["updated_host_ns"] - status["started_host_ns"]) * 1e-9
    kind = " ".join(filter(None, (sensor["product"], sensor["firmware"], sensor["mode"], sensor["profile"])))
    lost = ", ".join(f"{count} x {cause}" for cause, count in frames["losses"].items()) or "nothing"
    scenes = ", ".join(map(str, place["scenes"])) or "none"
    rows = [
        ("state", f"{status['state']}: {status['line']}"),
        ("program", f"{status['version']}, pid {status['pid']}, up {_duration(up_s)}"),
        ("sensor", f"{sensor['address']}: {sensor['phase']}" + (f", {kind}" if kind else "")),
        ("problem", sensor["problem"]),
        ("alerts", "; ".join(sensor["alerts"])),
        ("clock", sensor["clock"] + ("" if sensor["clock_synced"] in (True, None) else ", NOT synchronised")),
        ("frames", f"{frames['hz']:.1f} Hz, {frames['received']} received, {frames['rejected']} rejected"),
        ("lost", f"{lost}; {frames['lost_share']:.2%} of the last seconds' columns"),
        ("odometry", f"{place['odometry']}, lost {place['times_lost']} times"),
        ("place", f"session {place['session_id']}, map {place['map_id']}, scenes {scenes}"),
        (
            "detection",
            f"{detection['done']} done, {detection['waiting']} waiting, {detection['failed']} failed, "
            f"{detection['dropped']} dropped"
            + (f", busy for {detection['busy_s']:.0f} s" if detection["busy_s"] else ""),
        ),
        ("changes", f"{detection['present_changes']} present, {detection['new_changes']} new in this run"),
        (
            "disk",
            f"{store['data']}: {_gigabytes(store['used_bytes'])} of {_gigabytes(store['quota_bytes'])} used, "
            f"{_gigabytes(store['free_bytes'])} free, {store['scans']} scans, {store['scans_deleted']} removed",
        ),
        ("not stored", f"{frames['not_stored']} key scans" if frames["not_stored"] else ""),
        ("", store["problem"]),
        *(("repaired", what) for what in store["repairs"]),
        ("memory", f"{store['memory_bytes'] >> 20} + {store['detection_memory_bytes'] >> 20} MiB"),
        ("model", status["model_id"]),
        ("settings", status["settings"]),
    ]
    return "\n".join(f"{name:10s} {text}" for name, text in rows if text)


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    parts = [
        f"{value} {unit}" for value, unit in ((days, "d"), (hours, "h"), (minutes, "min"), (seconds, "s")) if value
    ]
    return " ".join(parts[:2]) or "0 s"


def _gigabytes(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.2f} GB"
