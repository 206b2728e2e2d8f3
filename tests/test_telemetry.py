"""A sensor's own health is asked for, and whatever it answers does no harm."""

import threading
import time

import pytest
from fake_sensor import fake_sensor

from revisitd.drivers.sensor_http import SensorHttp
from revisitd.drivers.telemetry import TelemetryPoller, read_telemetry

TELEMETRY, ALERTS, TIME = "/api/v1/sensor/telemetry", "/api/v1/sensor/alerts", "/api/v1/time"


def clock(mode: str, port_state: str = "LISTENING", pulse: int = 0, nmea: int = 0) -> dict:
    return {
        "ptp": {"port_data_set": {"port_state": port_state}},
        "sensor": {
            "timestamp": {"mode": mode},
            "sync_pulse_in": {"locked": pulse},
            "multipurpose_io": {"nmea": {"locked": nmea}},
        },
    }


def test_temperature_and_active_alerts_are_read():
    alert = {"active": True, "id": "0x01000015", "level": "WARNING", "msg": "Input voltage is low"}
    with fake_sensor() as fake:
        fake.others[TELEMETRY] = {"input_voltage_mv": 23606, "internal_temperature_deg_c": 42}
        fake.others[ALERTS] = {"active": [alert], "log": [alert, alert], "next_cursor": 2}
        seen = read_telemetry(SensorHttp(fake.address))
    assert seen.temperature_c == 42
    assert seen.alerts == ("WARNING 0x01000015: Input voltage is low",)


@pytest.mark.parametrize(
    "answer, synced",
    [
        (clock("TIME_FROM_INTERNAL_OSC", "SLAVE"), None),
        (clock("TIME_FROM_PTP_1588", "SLAVE"), True),
        (clock("TIME_FROM_PTP_1588", "UNCALIBRATED"), False),
        (clock("TIME_FROM_SYNC_PULSE_IN"), False),
        (clock("TIME_FROM_SYNC_PULSE_IN", pulse=1), True),
        (clock("TIME_FROM_SYNC_PULSE_IN", nmea=1), True),
    ],
)
def test_whether_its_clock_follows_another_is_told(answer, synced):
    with fake_sensor() as fake:
        fake.others[TIME] = answer
        assert read_telemetry(SensorHttp(fake.address)).clock_synced is synced


def test_old_firmware_that_tells_nothing_is_no_error():
    with fake_sensor() as fake:
        seen = read_telemetry(SensorHttp(fake.address))
    assert (seen.temperature_c, seen.alerts, seen.clock_synced) == (None, (), None)


def test_answers_of_another_shape_are_no_error():
    with fake_sensor() as fake:
        fake.others |= {TELEMETRY: {"internal_temperature_deg_c": "hot"}, ALERTS: {"active": ["?"]}, TIME: {"ptp": [1]}}
        seen = read_telemetry(SensorHttp(fake.address))
    assert (seen.temperature_c, seen.alerts, seen.clock_synced) == (None, ("?",), None)


def test_it_is_asked_again_and_again_while_it_is_wanted():
    stop, wanted = threading.Event(), threading.Event()
    with fake_sensor() as fake:
        fake.others[TELEMETRY] = {"internal_temperature_deg_c": 42}
        poller = TelemetryPoller(SensorHttp(fake.address), wanted.is_set, stop, period_s=0.01)
        assert poller.latest is None and not fake.requests
        wanted.set()
        deadline = time.monotonic() + 10
        while len(fake.requests) < 6 and time.monotonic() < deadline:
            time.sleep(0.01)
        stop.set()
        assert len(fake.requests) >= 6 and poller.latest.temperature_c == 42
