"""What a sensor says of its own health: temperature, alerts, and whether its clock follows another."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from .errors import SensorUnavailable
from .sensor_http import ALERTS, TELEMETRY, TIME, SensorHttp

PERIOD_S = 10.0
MOST_ALERTS, LONGEST_ALERT = 20, 200


@dataclass(frozen=True)
class Telemetry:
    """One look at a sensor. What it does not tell, as with older firmware, is None or empty."""

    host_ns: int
    temperature_c: float | None
    alerts: tuple[str, ...]  # active ones: "WARNING 0x01000015: ..."
    clock_synced: bool | None  # to PTP or its sync pulse; None with the internal oscillator


def read_telemetry(sensor: SensorHttp) -> Telemetry:
    """Asks a sensor; never raises for what it answers, or that it does not."""
    telemetry, alerts, clock = (_ask(sensor, path) for path in (TELEMETRY, ALERTS, TIME))
    active = alerts.get("active")
    return Telemetry(
        host_ns=time.time_ns(),
        temperature_c=_number(telemetry.get("internal_temperature_deg_c")),
        alerts=tuple(_alert(alert) for alert in active[:MOST_ALERTS]) if isinstance(active, list) else (),
        clock_synced=_is_synced(clock),
    )


class TelemetryPoller:
    """Asks every period_s, in a thread of its own, while is_wanted says so; ends when stopped."""

    def __init__(
        self,
        sensor: SensorHttp,
        is_wanted: Callable[[], bool],
        stop: threading.Event,
        period_s: float = PERIOD_S,
    ):
        self._sensor, self._is_wanted, self._stop, self._period_s = sensor, is_wanted, stop, period_s
        self.latest: Telemetry | None = None
        threading.Thread(target=self._run, name="telemetry", daemon=True).start()

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self.latest = read_telemetry(self._sensor) if self._is_wanted() else None


def _ask(sensor: SensorHttp, path: str) -> dict:
    try:
        return sensor.get(path)
    except SensorUnavailable:
        return {}


def _number(value: object) -> float | None:
    return value if isinstance(value, (int, float)) else None


def _alert(alert: object) -> str:
    if isinstance(alert, dict):
        alert = f"{alert.get('level')} {alert.get('id')}: {alert.get('msg')}"
    return " ".join(str(alert).split())[:LONGEST_ALERT]


def _is_synced(clock: dict) -> bool | None:
    match _part(clock, "sensor", "timestamp", "mode"):
        case "TIME_FROM_PTP_1588":
            return _part(clock, "ptp", "port_data_set", "port_state") == "SLAVE"
        case "TIME_FROM_SYNC_PULSE_IN":
            pulse, nmea = ("sync_pulse_in", "locked"), ("multipurpose_io", "nmea", "locked")
            return any(_part(clock, "sensor", *names) == 1 for names in (pulse, nmea))
    return None


def _part(document: object, *names: str) -> object:
    """The part of a document under these names; None where there is none."""
    for name in names:
        document = document.get(name) if isinstance(document, dict) else None
    return document
