"""A live sensor's HTTP interface: read its metadata, and have it send to us.

Not by the SDK, whose calls hold the GIL until the sensor answers: a slow one would stop every thread.
"""

import json
import socket
import threading
import time
from http.client import HTTPException
from ipaddress import ip_address
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, Request, build_opener

from .errors import SensorUnavailable

REQUEST_TIMEOUT_S = 4.0
READY_TIMEOUT_S = 60.0  # a sensor that was switched to NORMAL spins up first
POLL_S = 0.5
MOST_BYTES = 4 << 20
METADATA = "api/v1/sensor/metadata"
CONFIG = "api/v1/sensor/config?reinit=true&persist=false"  # gone at the next power-up: it is not our sensor


class SensorHttp:
    """One sensor. address: "os-122.local", "10.5.5.9", or with the HTTP port, "127.0.0.1:8080"."""

    def __init__(self, address: str):
        self.address = address
        # A sensor is on the local network: a proxy from the environment would only misroute the requests.
        self._opener = build_opener(ProxyHandler({}))

    def metadata(self) -> dict:
        """Raises SensorUnavailable where no Ouster sensor answers."""
        answer = self._request(METADATA)
        if not isinstance(answer, dict) or "config_params" not in answer or "sensor_info" not in answer:
            raise SensorUnavailable(f"http://{self.address}/{METADATA} is not a sensor's metadata")
        return answer

    def configure(self, params: dict) -> None:
        """Sets parameters until the sensor's next power-up, and restarts its lidar with them."""
        self._request(CONFIG, json.dumps(params).encode())

    def _request(self, path: str, body: bytes | None = None):
        url = f"http://{self.address}/{path}"
        request = Request(url, data=body, headers={"Content-Type": "application/json"})
        try:
            with self._opener.open(request, timeout=REQUEST_TIMEOUT_S) as response:
                text = response.read(MOST_BYTES)
        except HTTPError as error:
            error.close()
            raise SensorUnavailable(
                f"{url} answers {error.code} {error.reason}: no Ouster sensor, or firmware before 3.1"
            ) from None
        except (URLError, OSError, HTTPException, ValueError) as error:
            reason = getattr(error, "reason", error)
            raise SensorUnavailable(
                f"no sensor answers at http://{self.address} ({reason}): check its power, cable and address"
            ) from None
        try:
            return json.loads(text) if text.strip() else {}
        except ValueError:
            raise SensorUnavailable(f"{url} does not answer with JSON: no Ouster sensor") from None


def prepare_sensor(sensor: SensorHttp, stop: threading.Event) -> dict:
    """Has the sensor measure and send its packets here; returns its metadata once it runs.

    Raises SensorUnavailable where it does not answer or does not get ready; also when stopped.
    """
    our_address = local_address(sensor.address)
    metadata = sensor.metadata()
    changes = _changes(metadata["config_params"], our_address)
    if changes:
        sensor.configure(changes)
        stop.wait(POLL_S)  # for a moment it still tells the state before
        metadata = sensor.metadata()
    deadline = time.monotonic() + READY_TIMEOUT_S
    while (status := metadata["sensor_info"].get("status")) != "RUNNING":
        if status == "ERROR" or time.monotonic() > deadline or stop.wait(POLL_S):
            raise SensorUnavailable(f"sensor {sensor.address} does not run: its status is {status}")
        metadata = sensor.metadata()
    left = _changes(metadata["config_params"], our_address)
    if left:
        raise SensorUnavailable(f"sensor {sensor.address} does not take {left}")
    return metadata


def local_address(address: str) -> str:
    """The IP address of this machine that the sensor of this address can reach."""
    host = host_of(address)
    try:
        family, _, _, _, target = socket.getaddrinfo(host, 7502, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(target)  # sends nothing
            return probe.getsockname()[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "not a name"
        raise SensorUnavailable(f"there is no file and no sensor {host} ({reason})") from None


def host_of(address: str) -> str:
    """The address without the HTTP port."""
    host, colon, port = address.rpartition(":")
    return host if colon and port.isdigit() and ":" not in host else address


def _changes(params: dict, our_address: str) -> dict:
    """What must be set for the sensor to measure and to send here."""
    changes = {}
    if params.get("operating_mode") != "NORMAL":
        changes["operating_mode"] = "NORMAL"
    destination = params.get("udp_dest", "")
    if destination != our_address and not _is_shared(destination):
        changes["udp_dest"] = our_address
    return changes


def _is_shared(destination: str) -> bool:
    """Whether packets sent there also reach us: a multicast group, or everyone."""
    try:
        return ip_address(destination).is_multicast or destination == "255.255.255.255"
    except ValueError:
        return False
