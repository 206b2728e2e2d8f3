"""A live sensor's HTTP interface, firmware 3.1 and later.

Not by the SDK, whose calls hold the GIL until the sensor answers: a slow one would stop every thread.
"""

import json
import socket
import time
from http.client import HTTPException, HTTPResponse, responses
from urllib.request import HTTPErrorProcessor, ProxyHandler, Request, build_opener

from .errors import SensorRefused, SensorUnavailable

REQUEST_TIMEOUT_S = 4.0  # of each wait for the network
ANSWER_TIMEOUT_S = 8.0  # of a whole answer, which may come in drops
MOST_BYTES = 4 << 20
SHOWN_BYTES = 200  # of an answer that is quoted
METADATA = "api/v1/sensor/metadata"
CONFIG = "api/v1/sensor/config"
TELEMETRY = "api/v1/sensor/telemetry"
ALERTS = "api/v1/sensor/alerts"
TIME = "api/v1/time"


class SensorHttp:
    """One sensor. address: "os-122.local", "10.5.5.9", or with the HTTP port, "127.0.0.1:8080"."""

    def __init__(self, address: str):
        self.address = address
        # A sensor is on the local network: a proxy from the environment would only misroute the requests.
        self._opener = build_opener(ProxyHandler({}), _NoErrors)

    def metadata(self) -> dict:
        """Raises SensorUnavailable where no Ouster sensor answers."""
        answer = self.get(METADATA)
        parts = [answer.get(name) for name in ("config_params", "sensor_info")]
        if not all(isinstance(part, dict) for part in parts):
            raise SensorUnavailable(f"http://{self.address}/{METADATA} is not a sensor's metadata")
        return answer

    def configure(self, params: dict, persist: bool) -> None:
        """Sets parameters and restarts the lidar with them; without persist until the sensor's next power-up.

        Raises SensorRefused with what the sensor says of a value that it does not take.
        """
        path = f"{CONFIG}?reinit=true&persist={str(persist).lower()}"
        status, text = self._request(path, json.dumps(params).encode())
        if not _is_success(status):
            said = " ".join(text[:SHOWN_BYTES].decode("utf-8", "replace").split())
            raise SensorRefused(f"sensor {self.address} refuses {params}: {status} {said}")

    def get(self, path: str) -> dict:
        """A JSON object that the sensor tells of itself. Raises SensorUnavailable where there is none."""
        status, text = self._request(path)
        if not _is_success(status):
            raise SensorUnavailable(
                f"http://{self.address}/{path} answers {status} {responses.get(status, '')}: "
                "no Ouster sensor, or one whose firmware must be updated to 3.1 or newer"
            )
        try:
            answer = json.loads(text)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict):
            raise SensorUnavailable(f"http://{self.address}/{path} does not answer with JSON: no Ouster sensor")
        return answer

    def _request(self, path: str, body: bytes | None = None) -> tuple[int, bytes]:
        """HTTP status and the answer."""
        url = f"http://{self.address}/{path}"
        try:
            request = Request(url, data=body, headers={"Content-Type": "application/json"})
            with self._opener.open(request, timeout=REQUEST_TIMEOUT_S) as response:
                return response.status, _read(response)
        except (OSError, HTTPException, ValueError, OverflowError) as error:  # the last: of a port number
            reason = getattr(error, "reason", error)
            raise SensorUnavailable(
                f"no sensor answers at http://{self.address} ({reason}): check its power, cable and address"
            ) from None


class _NoErrors(HTTPErrorProcessor):
    """Gives answers of failure as any other: they say what is wrong."""

    def http_response(self, request: Request, response: HTTPResponse) -> HTTPResponse:
        return response


def resolve(address: str) -> tuple[str, str]:
    """The sensor's IP address, and that of this machine which it can reach.

    Here and not by the SDK, which holds the GIL while a name is looked up. Raises SensorUnavailable.
    """
    host = host_of(address)
    try:
        # IPv4 where there is both: an address that only counts on one network card means nothing to the sensor.
        found = socket.getaddrinfo(host, 7502, type=socket.SOCK_DGRAM)
        family, _, _, _, target = min(found, key=lambda entry: entry[0] != socket.AF_INET)
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(target)  # sends nothing
            return target[0], probe.getsockname()[0]
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a name"
        raise SensorUnavailable(f"there is no sensor {host} ({reason}): check its name, and the network") from None


def host_of(address: str) -> str:
    """The address without the HTTP port."""
    host, colon, port = address.rpartition(":")
    return host if colon and port.isdigit() and ":" not in host else address


def _is_success(status: int) -> bool:
    return 200 <= status < 300


def _read(response: HTTPResponse) -> bytes:
    """At most MOST_BYTES of an answer. Raises TimeoutError where it does not come to its end."""
    deadline = time.monotonic() + ANSWER_TIMEOUT_S
    text = b""
    while len(text) < MOST_BYTES and (part := response.read1(1 << 16)):
        text += part
        if time.monotonic() > deadline:
            raise TimeoutError("its answer does not end")
    return text
