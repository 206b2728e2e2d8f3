"""The status as a Prometheus text file, for node_exporter's textfile collector: no port is opened."""

from __future__ import annotations

from pathlib import Path

from .status import Status

METRICS_FILE = "revisitd.prom"  # beside the status; point the collector's directory at it, or link it there


def write_metrics(path: Path, status: Status) -> None:
    """Replace the file at once: a collector must never read half of it. Raises OSError."""
    unfinished = path.with_name(f".{path.name}.tmp")
    unfinished.write_text(metrics_text(status), encoding="utf-8")
    unfinished.replace(path)


def metrics_text(status: Status) -> str:
    """Prometheus exposition format 0.0.4. Times in seconds, sizes in bytes; counters begin at the program's start."""
    frames, place, detection, store = status.frames, status.place, status.detection, status.store
    lines: list[str] = []

    def metric(name: str, kind: str, about: str, *samples: tuple[str, float]) -> None:
        lines.extend((f"# HELP revisitd_{name} {about}", f"# TYPE revisitd_{name} {kind}"))
        lines.extend(f"revisitd_{name}{labels} {value:.15g}" for labels, value in samples)

    def counter(name: str, about: str, value: int) -> None:
        metric(f"{name}_total", "counter", about, ("", value))

    def gauge(name: str, about: str, value: float) -> None:
        metric(name, "gauge", about, ("", value))

    metric("info", "gauge", "Versions, as labels.", (_labels(version=status.version, model=status.model_id), 1))
    gauge("up", "1 where frames come in and the odometry is good.", float(status.state == "running"))
    gauge("start_time_seconds", "Start of the program, Unix time.", status.started_host_ns * 1e-9)
    gauge("status_time_seconds", "When this file was written, Unix time.", status.updated_host_ns * 1e-9)
    counter("sensor_openings", "Times the sensor was opened.", status.sensor.times_opened)
    if status.sensor.temperature_c is not None:
        gauge("sensor_temperature_celsius", "Of the sensor, by its telemetry.", status.sensor.temperature_c)
    gauge("sensor_alerts", "Alerts that the sensor has active.", len(status.sensor.alerts))
    gauge("frame_rate_hertz", "Frames in the last seconds.", frames.hz)
    gauge("columns_lost_ratio", "Share of the columns of the last seconds that did not arrive.", frames.lost_share)
    counter("frames", "Frames received.", frames.received)
    counter("frames_rejected", "Frames that were not used.", frames.rejected)
    counter("key_scans", "Key scans.", place.key_scans)
    counter("key_scans_not_stored", "Key scans that the disk did not take.", frames.not_stored)
    causes = [(_labels(cause=cause), count) for cause, count in frames.losses.items()]
    metric("losses_total", "counter", "Packets, columns and frames lost, by cause.", *causes)
    counter("odometry_lost", "Times the odometry was lost.", place.times_lost)
    gauge("detection_busy_seconds", "How long the instance at hand has taken.", detection.busy_s)
    gauge("instances_waiting", "Instances of change detection in the queue.", detection.waiting)
    for outcome in ("done", "failed", "dropped"):
        counter(f"instances_{outcome}", f"Instances of change detection {outcome}.", getattr(detection, outcome))
    counter("changes_new", "Change objects found since the start.", detection.new_changes)
    gauge("changes_present", "Change objects in the store that hold.", detection.present_changes)
    gauge("store_bytes", "Size of the data directory.", store.used_bytes)
    gauge("store_quota_bytes", "What it may grow to.", store.quota_bytes)
    gauge("disk_free_bytes", "Free on its file system.", store.free_bytes)
    gauge("scans", "Key scans in the store.", store.scans)
    counter("scans_deleted", "Key scans removed for the quota since the start.", store.scans_deleted)
    metric(
        "memory_bytes",
        "gauge",
        "Resident memory.",
        (_labels(process="main"), store.memory_bytes),
        (_labels(process="detection"), store.detection_memory_bytes),
    )
    return "\n".join(lines) + "\n"


def _labels(**labels: str) -> str:
    escaped = (text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n") for text in labels.values())
    return "{" + ",".join(f'{name}="{text}"' for name, text in zip(labels, escaped, strict=True)) + "}"
