"""A live sensor's HTTP interface, firmware 3.1 and later.

Not by the SDK, whose calls hold the GIL until the sensor answers: a slow one would stop every thread.
"""

import json
import socket
import time
from http.client import HTTPException, HTTPResponse
from urllib.error import HTTPError, URLError
from urllib.request import ProxyHandler, Request, build_opener

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
        self._opener = build_opener(ProxyHandler({}))

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
        try:
            self._request(path, json.dumps(params).encode())
        except HTTPError as error:
            with error:
                said = " ".join(_read(error)[:SHOWN_BYTES].decode("utf-8", "replace").split())
            raise SensorRefused(f"sensor {self.address} refuses {params}: {error.code} {said}") from None

    def get(self, path: str) -> dict:
        """A JSON object that the sensor tells of itself. Raises SensorUnavailable where there is none."""
        try:
            text = self._request(path)
        except HTTPError as error:
            error.close()
            raise SensorUnavailable(
                f"http://{self.address}/{path} answers {error.code} {error.reason}: "
                "no Ouster sensor, or firmware before 3.1"
            ) from None
        try:
            answer = json.loads(text)
        except (ValueError, RecursionError):
            answer = None
        if not isinstance(answer, dict):
            raise SensorUnavailable(f"http://{self.address}/{path} does not answer with JSON: no Ouster sensor")
        return answer

    def _request(self, path: str, body: bytes | None = None) -> bytes:
        """The answer; raises HTTPError where it is one of failure."""
        url = f"http://{self.address}/{path}"
        request = Request(url, data=body, headers={"Content-Type": "application/json"})
        try:
            with self._opener.open(request, timeout=REQUEST_TIMEOUT_S) as response:
                return _read(response)
        except HTTPError:
            raise
        except (URLError, OSError, HTTPException, ValueError) as error:
            reason = getattr(error, "reason", error)
            raise SensorUnavailable(
                f"no sensor answers at http://{self.address} ({reason}): check its power, cable and address"
            ) from None


def resolve(address: str) -> tuple[str, str]:
    """The sensor's IP address, and that of this machine which it can reach.

    Here and not by the SDK, which holds the GIL while a name is looked up. Raises SensorUnavailable.
    """
    host = host_of(address)
    try:
        family, _, _, _, target = socket.getaddrinfo(host, 7502, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect(target)  # sends nothing
            return target[0], probe.getsockname()[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "not a name"
        raise SensorUnavailable(f"there is no file and no sensor {host} ({reason})") from None


def host_of(address: str) -> str:
    """The address without the HTTP port."""
    host, colon, port = address.rpartition(":")
    return host if colon and port.isdigit() and ":" not in host else address


def _read(response: HTTPResponse) -> bytes:
    """At most MOST_BYTES of an answer. Raises TimeoutError where it does not come to its end."""
    deadline = time.monotonic() + ANSWER_TIMEOUT_S
    text = b""
    while len(text) < MOST_BYTES and (part := response.read1(1 << 16)):
        text += part
        if time.monotonic() > deadline:
            raise TimeoutError("its answer does not end")
    return text
