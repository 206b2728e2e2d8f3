"""A sensor for tests: answers HTTP and sends UDP packets, all as the test says."""

import json
import socket
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from captures import metadata

METADATA = "/api/v1/sensor/metadata"


class FakeSensor:
    """Answers HTTP as a sensor does, and sends UDP packets from the same address."""

    def __init__(self, document: dict):
        self.document = document
        self.others: dict[str, object] = {}  # path -> what else is answered
        self.requests: list[tuple[str, str]] = []
        self.set: list[dict] = []
        self.accepts = True
        self.answers_post = 200
        fake = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                fake.requests.append(("GET", self.path))
                fake.answer(self, fake.document if self.path == METADATA else fake.others.get(self.path))

            def do_POST(self):
                fake.requests.append(("POST", self.path))
                fake.set.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
                if fake.accepts:
                    fake.document["config_params"] |= fake.set[-1]
                fake.document["sensor_info"]["status"] = "RUNNING"
                fake.answer(self, {}, fake.answers_post)

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"127.0.0.1:{self.server.server_port}"
        self.thread = threading.Thread(target=self.server.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))

    def answer(self, handler: BaseHTTPRequestHandler, document: dict | None, status: int = 200) -> None:
        handler.send_response(404 if document is None else status)
        handler.end_headers()
        handler.wfile.write(json.dumps(document).encode())

    def send(self, payloads: list[bytes]) -> None:
        port = self.document["config_params"]["udp_port_lidar"]
        for payload in payloads:
            self.socket.sendto(payload, ("127.0.0.1", port))

    def close(self) -> None:
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()
        self.socket.close()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def fake_sensor(profile: str = "RNG19_RFL8_SIG16_NIR16", **changes):
    document = metadata(profile, **{"config_params__udp_port_lidar": free_port()} | changes)
    fake = FakeSensor(document)
    try:
        yield fake
    finally:
        fake.close()
