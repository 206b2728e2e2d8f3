"""The virtual sensor: plays a capture at its own speed, as it is configured, with the faults asked for."""

import contextlib
import queue
import random
import socket
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .api import HTTP_FAULTS, Api
from .capture import IMU_BYTES, Capture
from .device import FIRST_BOOT_NS, PTP, Device, Refused
from .playback import Rewriter, Timeline, shift_imu
from .transcode import Transcoder

LONGEST_LAG_S = 1.0  # a machine that was asleep longer goes on from where it is: what was due is not sent in one burst


@dataclass(frozen=True)
class Faults:
    """What may go wrong; each is asked for by its name, and the others stay as they are."""

    drop: float = 0.0  # share of packets that are not sent, from now on
    corrupt: float = 0.0  # share of packets with a wrong byte, from now on
    silence_s: float = 0.0  # nothing is sent for so long; frames go on unseen
    reboot_s: float = 0.0  # off, and on again after so long
    step_s: float = 0.0  # the sensor's clock jumps; frame ids go on
    http: str = "none"  # answers by HTTP: error (500), garbage, slow


class Emulator:
    """A sensor made of a capture. host: its address here; http_port: 0 for any that is free.

    loop: plays the capture again and again. rate: times real time. serial: another than the capture's. warmup_s:
    until a new configuration holds. seed: of the random faults. Raises DriverError for what cannot be played, or
    where.
    """

    def __init__(
        self,
        capture: Path,
        meta: Path | None = None,
        host: str = "127.0.0.1",
        http_port: int = 0,
        loop: bool = False,
        rate: float = 1.0,
        serial: int | None = None,
        warmup_s: float = 1.0,
        seed: int = 0,
    ):
        self._capture, self._loop, self._rate = Capture(capture, meta), loop, rate
        self._device = Device(self._capture.metadata, serial, warmup_s)
        self._api = Api(self._device, host, http_port, self.inject)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))  # clients take no packet from another address than the one they asked
        self._timeline = Timeline(round(1e9 / self._capture.info.format.fps))
        self._random = random.Random(seed)
        self._asked: queue.SimpleQueue[dict] = queue.SimpleQueue()
        self._drop = self._corrupt = 0.0
        self._boot_until_s = self._silent_until_s = 0.0
        self._clock_ns = FIRST_BOOT_NS  # the sensor's clock at played time 0
        self._clock_is_ptp, self._n_boots = False, 0
        self._start_s = time.monotonic()  # at played time 0
        self._fit()

    @property
    def address(self) -> str:
        """Where its HTTP answers."""
        return self._api.address

    def inject(self, faults: dict) -> None:
        """faults: by the names of Faults. Raises Refused where one is unknown."""
        for name, value in faults.items():
            wanted = type(getattr(Faults, name, None))
            if not isinstance(value, (int, float) if wanted is float else wanted):
                raise Refused(f"there is no fault {name} = {value!r}")
        if faults.get("http", "none") not in HTTP_FAULTS:
            raise Refused(f"http can be {', '.join(HTTP_FAULTS)}")
        self._asked.put(faults)

    def run(self, stop: threading.Event, schedule: list[tuple[float, dict]]) -> None:
        """Plays until stopped, or until a capture that is not looped ends.

        schedule: faults and after how many seconds of playing they come, in order.
        """
        for payloads in self._capture.passes(self._loop):
            self._timeline.join()
            for payload in payloads:
                if stop.is_set():
                    return
                while schedule and self._timeline.played_ns * 1e-9 >= schedule[0][0]:
                    self.inject(schedule.pop(0)[1])
                self._suffer()
                self._play(payload)

    def close(self) -> None:
        self._api.stop()
        self._socket.close()

    def _suffer(self) -> None:
        """Takes up what has been asked for, and what has changed by HTTP."""
        while not self._asked.empty():
            self._fail(self._asked.get())
        if self._boot_until_s and time.monotonic() >= self._boot_until_s:
            self._boot_until_s = 0.0
            self._api.start()
        if self._device.generation != self._generation:
            self._fit()

    def _fail(self, faults: dict) -> None:
        self._drop = faults.get("drop", self._drop)
        self._corrupt = faults.get("corrupt", self._corrupt)
        self._api.fault = faults.get("http", self._api.fault)
        self._clock_ns += round(faults.get("step_s", 0) * 1e9)
        if "silence_s" in faults:
            self._silent_until_s = time.monotonic() + faults["silence_s"]
        if "reboot_s" in faults:
            self._api.stop()
            self._boot_until_s = time.monotonic() + faults["reboot_s"]
            self._device.reboot(faults["reboot_s"])

    def _fit(self) -> None:
        """Plays on as the device is configured after its restart."""
        device = self._device
        info, as_recorded = device.info(), device.recorded
        kept = ("lidar_mode", "udp_profile_lidar", "azimuth_window")
        fits = all(device.config[name] == as_recorded[name] for name in kept)
        self._transcoder = None if fits else Transcoder(self._capture.info, info)
        self._rewriter = Rewriter(info, self._timeline)
        self._timeline.restart_ids()
        if device.config["timestamp_mode"] == PTP:
            self._clock_ns = time.time_ns() - self._timeline.played_ns
        elif device.n_boots != self._n_boots or self._clock_is_ptp:
            self._clock_ns = FIRST_BOOT_NS - self._timeline.played_ns
        self._clock_is_ptp = device.config["timestamp_mode"] == PTP
        self._generation, self._n_boots = device.generation, device.n_boots

    def _play(self, payload: bytes) -> None:
        """One packet of the capture, when it is due."""
        if len(payload) == IMU_BYTES:
            if self._timeline.shift_ns is not None:
                self._send(shift_imu(payload, self._timeline.shift_ns + self._clock_ns), "udp_port_imu")
        elif self._transcoder is None:
            self._play_lidar(payload)
        else:
            for packet in self._transcoder.packets(payload):
                self._play_lidar(packet.buf)

    def _play_lidar(self, payload: bytes | np.ndarray) -> None:
        played_ns = self._rewriter.rewrite(payload, self._clock_ns, self._device.ids)
        if played_ns is not None:
            self._wait_until(played_ns)
            self._send(self._rewriter.buffer, "udp_port_lidar")

    def _wait_until(self, played_ns: int) -> None:
        now = time.monotonic()
        due_s = self._start_s + played_ns * 1e-9 / self._rate
        if due_s > now:
            time.sleep(due_s - now)
        elif now - due_s > LONGEST_LAG_S:
            self._start_s += now - due_s

    def _send(self, payload: bytes | np.ndarray, port: str) -> None:
        config = self._device.config
        if self._device.status != "RUNNING" or not config["udp_dest"] or time.monotonic() < self._silent_until_s:
            return
        if self._random.random() < self._drop:
            return
        if self._random.random() < self._corrupt:
            payload = bytearray(payload)
            payload[self._random.randrange(len(payload))] ^= 0xFF
        with contextlib.suppress(OSError):  # a sensor does not know whether its packets arrive
            self._socket.sendto(payload, (config["udp_dest"], config[port]))
