"""The HTTP interface of a sensor with firmware 3.1: what the live source and the SDK ask, and faults on demand."""

import json
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from urllib.parse import parse_qs, urlsplit

from ..errors import SensorUnavailable
from .device import PTP, Device, Refused

API = "/api/v1/"
FAULTS_PATH = "/emulator/faults"
SLOW_S = 3.0
POLL_S = 0.02
HTTP_FAULTS = ("none", "error", "garbage", "slow")


class Api:
    """Answers for one device, in threads. inject: takes the faults that are POSTed to FAULTS_PATH."""

    def __init__(self, device: Device, host: str, port: int, inject: Callable[[dict], None]):
        self._device, self._inject = device, inject
        self._host, self._port = host, port
        self._server: ThreadingHTTPServer | None = None
        self.fault = "none"  # of HTTP_FAULTS
        self.start()
        self._port = self._server.server_port  # where 0 was given, any that is free

    @property
    def address(self) -> str:
        return f"{self._host}:{self._port}"

    def start(self) -> None:
        """Listens. Raises SensorUnavailable where the port is taken, or the address is not one of this machine."""
        try:
            self._server = ThreadingHTTPServer((self._host, self._port), _handler(self))
        except OSError as error:
            raise SensorUnavailable(
                f"no sensor can be at http://{self.address} ({error.strerror}): give another --http-port or --host"
            ) from None
        threading.Thread(target=self._server.serve_forever, args=(POLL_S,), name="sensor HTTP", daemon=True).start()

    def stop(self) -> None:
        """Refuses connections, as a sensor that boots does."""
        if self._server:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def get(self, path: str, query: dict[str, str]) -> object:
        """The answer to a GET. Raises KeyError where there is nothing at this path."""
        metadata = self._device.metadata()
        match path.strip("/").split("/"):
            case ["sensor", "metadata"]:
                return metadata
            case ["sensor", "metadata", part]:
                return metadata[part]
            case ["sensor", "config"]:
                return self._device.staged if query.get("staging") == "true" else self._device.config
            case ["sensor", "config", name]:
                return self._device.config[name]
            case ["sensor", "telemetry"]:
                return {"input_current_ma": 760, "input_voltage_mv": 23_600, "internal_temperature_deg_c": 42}
            case ["sensor", "alerts"]:
                return {"active": [], "log": [], "next_cursor": 0}
            case ["system", "firmware"]:
                return {"fw": metadata["sensor_info"]["image_rev"]}
            case ["time"]:
                return self._time()
            case ["time", part]:
                return self._time()[part]
            case ["user", "data"]:
                return ""
        raise KeyError(path)

    def post(self, path: str, query: dict[str, str], body: dict, client: str) -> object:
        """The answer to a POST. Raises KeyError, or Refused with the reason."""
        if path == FAULTS_PATH:
            self._inject(body)
        elif path == API + "sensor/config":
            self._device.configure(
                _addressed(body, client), query.get("reinit") == "true", query.get("persist") == "true"
            )
        else:
            raise KeyError(path)
        return {}

    def _time(self) -> dict:
        mode = self._device.config["timestamp_mode"]
        locked = mode == PTP
        return {
            "ptp": {
                "port_data_set": {"port_state": "SLAVE" if locked else "LISTENING"},
                "time_status_np": {"gm_present": locked, "master_offset": 0},
            },
            "sensor": {
                "multipurpose_io": {"mode": "OFF", "nmea": {"locked": 0}},
                "sync_pulse_in": {"locked": 0},
                "timestamp": {"mode": mode},
            },
        }


def _addressed(params: dict, client: str) -> dict:
    """With @auto replaced by the address that asks. Raises Refused where udp_dest is no address."""
    if "udp_dest" not in params or params["udp_dest"] == "":
        return params
    if params["udp_dest"] == "@auto":
        return params | {"udp_dest": client}
    try:
        ip_address(params["udp_dest"])
    except ValueError:
        raise Refused(f"udp_dest cannot be {params['udp_dest']!r}") from None
    return params


def _handler(api: Api) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self._answer(lambda path, query: api.get(path.removeprefix(API), query))

        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            self._answer(lambda path, query: api.post(path, query, _parameters(body), self.client_address[0]))

        def log_message(self, *_arguments) -> None:
            """Says nothing."""

        def _answer(self, answer: Callable[[str, dict[str, str]], object]) -> None:
            url = urlsplit(self.path)  # a client that takes this for its proxy gives the whole URL
            query = {name: values[0].lower() for name, values in parse_qs(url.query).items()}
            code = 200
            try:
                document = answer(url.path, query)
            except KeyError:
                code, document = 404, {"error": "not found"}
            except Refused as error:
                code, document = 400, {"error": str(error)}
            text = json.dumps(document).encode()
            if url.path != FAULTS_PATH:
                code, text = self._spoilt(code, text)
            self.send_response(code)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def _spoilt(self, code: int, text: bytes) -> tuple[int, bytes]:
            if api.fault == "slow":
                time.sleep(SLOW_S)
            if api.fault == "error":
                return 500, b'{"error": "internal server error"}'
            return code, text[: len(text) // 2] if api.fault == "garbage" else text

    return Handler


def _parameters(body: bytes) -> dict:
    try:
        params = json.loads(body or b"{}")
    except ValueError:
        params = None
    if not isinstance(params, dict):
        raise Refused("the body is no JSON object")
    return params
