"""How a live sensor shall be set: what is wished, what it takes for the sensor to send here, and setting it."""

import logging
import threading
import time
from dataclasses import dataclass
from ipaddress import ip_address

from .errors import SensorChanged, SensorRefused, SensorTaken, SensorUnavailable
from .sensor_http import SensorHttp

logger = logging.getLogger(__name__)

READY_TIMEOUT_S = 60.0  # a sensor that was switched to NORMAL spins up first
POLL_S = 0.5
LONGEST_SHOWN = 60


@dataclass(frozen=True)
class SensorWish:
    """Settings that the sensor shall have, by the sensor's own names; None: as it is."""

    lidar_mode: str | None = None  # columns x rotations/s, "1024x10"
    udp_profile_lidar: str | None = None  # "RNG19_RFL8_SIG16_NIR16"
    timestamp_mode: str | None = None  # "TIME_FROM_PTP_1588"
    azimuth_window: tuple[int, int] | None = None  # millidegrees, from and to
    udp_port_lidar: int | None = None
    persist: bool = False  # also for after the sensor's next power-up

    def wanted(self, our_address: str) -> dict:
        """What the sensor's configuration must say for it to measure as wished, and to send to our address."""
        wished = {
            "lidar_mode": self.lidar_mode,
            "udp_profile_lidar": self.udp_profile_lidar,
            "timestamp_mode": self.timestamp_mode,
            "azimuth_window": self.azimuth_window and list(self.azimuth_window),
            "udp_port_lidar": self.udp_port_lidar,
        }
        required = {"operating_mode": "NORMAL", "udp_dest": our_address}
        return required | {name: value for name, value in wished.items() if value is not None}


AS_IT_IS = SensorWish()


def prepare_sensor(sensor: SensorHttp, wish: SensorWish, our_address: str, stop: threading.Event) -> dict:
    """Has the sensor measure as wished and send its packets here; returns its metadata once it runs.

    Raises SensorUnavailable where it does not answer or does not get ready, also when stopped; SensorRefused
    where it does not take the settings.
    """
    wanted = wish.wanted(our_address)
    metadata = sensor.metadata()
    changes = _differing(metadata["config_params"], wanted)
    if changes:
        logger.info("sensor %s is set: %s", sensor.address, _listed(changes))
        sensor.configure(changes, wish.persist)
        stop.wait(POLL_S)  # for a moment it still tells the state before
        metadata = sensor.metadata()
    deadline = time.monotonic() + READY_TIMEOUT_S
    while (status := metadata["sensor_info"].get("status", "RUNNING")) != "RUNNING":
        if status == "ERROR" or time.monotonic() > deadline or stop.wait(POLL_S):
            raise SensorUnavailable(f"sensor {sensor.address} does not run: its status is {_shown(status)}")
        metadata = sensor.metadata()
    left = _differing(metadata["config_params"], wanted)
    if left:
        raise SensorRefused(f"sensor {sensor.address} does not take {_listed(left)}")
    return metadata


def require_unchanged(sensor: SensorHttp, wish: SensorWish, our_address: str, init_id: int) -> None:
    """Asks a sensor that was prepared whether it still is.

    Raises SensorTaken or SensorChanged with what is different, SensorUnavailable where it does not answer.
    """
    metadata = sensor.metadata()
    config, info = metadata["config_params"], metadata["sensor_info"]
    changed = _differing(config, wish.wanted(our_address))
    if changed:
        now = _listed({name: config.get(name) for name in changed})
        error = SensorTaken if config.get("udp_dest") else SensorChanged  # after a restart it sends to nobody
        raise error(
            f"sensor {sensor.address} now has {now}, not {_listed(changed)}: another client took its stream, "
            "or it was restarted"
        )
    status = info.get("status", "RUNNING")
    if status != "RUNNING" or info.get("initialization_id", init_id) != init_id:
        raise SensorChanged(f"sensor {sensor.address} was restarted or reconfigured: its status is {_shown(status)}")


def _differing(config: dict, wanted: dict) -> dict:
    """Those of the wanted parameters that the configuration does not have."""
    changes = {name: value for name, value in wanted.items() if config.get(name) != value}
    if _is_shared(config.get("udp_dest")):
        changes.pop("udp_dest", None)
    return changes


def _is_shared(destination: object) -> bool:
    """Whether packets sent there also reach us: a multicast group, or everyone."""
    try:
        return ip_address(destination).is_multicast or destination == "255.255.255.255"
    except ValueError:
        return False


def _listed(params: dict) -> str:
    return ", ".join(f"{name} = {_shown(value)}" for name, value in params.items())


def _shown(value: object) -> str:
    """What a sensor says, or whatever answers in its place, as a part of a line."""
    return repr(value)[:LONGEST_SHOWN]
