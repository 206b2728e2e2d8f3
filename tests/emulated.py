"""Emulators for tests: each a process of its own, since the live source holds the GIL."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.request import Request, urlopen


class Emulated:
    """A running `revisitd emulate`."""

    def __init__(self, address: str):
        self.address = address

    def get(self, path: str) -> object:
        with urlopen(f"http://{self.address}/api/v1/{path}", timeout=10) as answer:
            return json.loads(answer.read())

    def configure(self, query: str = "reinit=true", **params) -> None:
        """As another client does."""
        self._post(f"/api/v1/sensor/config?{query}", params)

    def inject(self, **faults) -> None:
        """See drivers.emulator.Faults."""
        self._post("/emulator/faults", faults)

    def reset(self) -> None:
        """As it was when it started, but with another init id."""
        self.inject(http="none")
        before = self._init_id()
        self.inject(drop=0, corrupt=0, silence_s=0, reboot_s=0)
        while True:
            with suppress(OSError):  # for a moment it boots
                if self._init_id() != before:
                    return

    def _init_id(self) -> int:
        return self.get("sensor/metadata/sensor_info")["initialization_id"]

    def _post(self, path: str, body: dict) -> None:
        request = Request(f"http://{self.address}{path}", data=json.dumps(body).encode(), method="POST")
        urlopen(request, timeout=10).close()


@contextmanager
def emulated(capture: Path, *options: str, port: int = 0) -> Iterator[Emulated]:
    """The sensor that recorded the capture, looped; ready at once after a new configuration."""
    command = [sys.executable, "-c", "from revisitd.daemon.cli import main; main()", "emulate", str(capture)]
    command += ["--http-port", str(port), "--loop", "--warmup", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Emulated(process.stdout.readline().split()[-1])
        finally:
            process.terminate()
