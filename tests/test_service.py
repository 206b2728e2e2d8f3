"""The daemon as its user runs it: a process, a sensor on the network, signals, systemd's socket, a status."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from revisitd.daemon.status import NotRunning, read_status
from revisitd.storage.store import Store

virtual = pytest.importorskip("revisitd.drivers.virtual", reason="the virtual sensor needs the extra [sim]")

PROGRAM = "from revisitd.daemon.cli import main\nif __name__ == '__main__':\n    main()\n"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Eight seconds of a small patrol."""
    made = virtual.simulate(
        tmp_path_factory.mktemp("patrol"), scenario="tiny", seed=1, beams=32, columns=512, max_s=8.0
    )
    return made.pcap


class Process:
    """revisitd with some arguments, and what it tells systemd."""

    def __init__(self, folder: Path, *arguments: object, **environment: str):
        program = folder / "program.py"  # a file: the detection process is made anew from it
        program.write_text(PROGRAM)
        self.told: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        address = folder / f"notify-{len(list(folder.iterdir()))}"
        self._socket.bind(str(address))
        threading.Thread(target=self._listen, daemon=True).start()
        self._process = subprocess.Popen(
            [sys.executable, str(program), *map(str, arguments)],
            env={**os.environ, "NOTIFY_SOCKET": str(address), **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def _listen(self) -> None:
        while message := self._socket.recv(4096).decode():
            self.told.extend(message.splitlines())

    def says(self, words: str) -> None:
        """Reads its output until it says so."""
        for line in self._process.stdout:
            if words in line:
                return
        raise AssertionError(f"it ended and never said {words!r}")

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def end(self, number: int) -> int:
        """Sends a signal; the exit code that follows."""
        self.signal(number)
        self._process.communicate(timeout=PATIENCE_S)
        return self._process.returncode


def until(reached, what):
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if reached():
            return
        time.sleep(0.05)
    raise AssertionError(f"not within {PATIENCE_S:g} s: {what}")


@pytest.fixture
def start(tmp_path):
    """Starts revisitd; what still runs at the test's end is killed."""
    running = []

    def begin(*arguments, **environment):
        running.append(Process(tmp_path, *arguments, **environment))
        return running[-1]

    yield begin
    for process in running:
        if process._process.poll() is None:
            process.end(signal.SIGKILL)
        process._process.stdout.close()


def status_of(data):
    try:
        return read_status(data)
    except NotRunning:
        return None


def test_it_waits_for_its_sensor_follows_it_and_stops_in_order(start, capture, tmp_path):
    port, data, settings = free_port(), tmp_path / "data", tmp_path / "revisitd.toml"
    settings.write_text(f'[sensor]\naddress = "127.0.0.1:{port}"\nudp_port_lidar = {free_port()}\n')
    daemon = start("run", "--config", settings, "--data", data, WATCHDOG_USEC="4000000")
    daemon.says("no sensor answers")
    until(lambda: "READY=1" in daemon.told and status_of(data), "ready without a sensor")
    until(lambda: "no sensor answers" in status_of(data)["sensor"]["problem"], "the problem is told")
    assert status_of(data)["state"] == "waiting"

    start("emulate", capture, "--http-port", port, "--loop")
    until(lambda: status_of(data)["frames"]["received"] > 20, "frames")
    until(lambda: status_of(data)["place"]["key_scans"] > 2, "key scans")
    shown = status_of(data)
    assert (shown["sensor"]["phase"], shown["sensor"]["mode"]) == ("running", "512x10")
    assert shown["place"]["session_id"] and shown["store"]["free_bytes"] > 0
    until(lambda: daemon.told.count("WATCHDOG=1") > 2, "the watchdog is fed")
    assert "revisitd_frames_total" in (data / "revisitd.prom").read_text()

    begun = time.monotonic()
    assert daemon.end(signal.SIGTERM) == 0
    assert time.monotonic() - begun < 10.0  # what systemd and people wait for
    assert "STOPPING=1" in daemon.told
    assert status_of(data) is None
    with Store.open_reader(data) as store:
        assert store.index.counts()["scans"] >= shown["place"]["key_scans"]
        assert store.index.sessions()[0].source == f"127.0.0.1:{port}"


def test_settings_are_reloaded_and_what_needs_a_restart_is_named(start, tmp_path):
    settings = tmp_path / "revisitd.toml"
    settings.write_text('[sensor]\naddress = "127.0.0.1:9"\n')
    daemon = start("run", "--config", settings, "--data", tmp_path / "data")
    daemon.says("no sensor answers")
    settings.write_text('[sensor]\naddress = "127.0.0.1:9"\n[detection]\ntau_m = 0.2\n[odometry]\nvoxel_size_m = 0.8\n')
    daemon.signal(signal.SIGHUP)
    daemon.says("settings reloaded: detection changed")
    daemon.says("after a restart only: odometry")
    settings.write_text("[detection]\ntau = 0.2\n")
    daemon.signal(signal.SIGHUP)
    daemon.says("the old ones stay in force")
    assert daemon.end(signal.SIGTERM) == 0
    assert any(line.startswith("RELOADING=1") for line in daemon.told)


def test_a_second_daemon_does_not_write_to_the_same_data(start, tmp_path):
    first = start("run", "--source", "127.0.0.1:9", "--data", tmp_path / "data")
    first.says("no sensor answers")
    second = start("run", "--source", "127.0.0.1:9", "--data", tmp_path / "data")
    second.says("writes here; stop it, or use another directory")
    assert second._process.wait(PATIENCE_S) == 74
    assert first.end(signal.SIGINT) == 0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
