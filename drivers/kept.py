"""A sensor that is kept open: whatever it or the network does is stated, waited for, and mended where it can be."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Future, wait
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from .errors import DriverError, SensorChanged, SensorTaken, SensorUnavailable
from .faults import FaultWatch
from .frame import Frame, Sensor
from .live import LiveSource
from .sensor_http import SensorHttp, resolve
from .sensor_setup import SensorWish, require_unchanged
from .telemetry import Telemetry, TelemetryPoller

logger = logging.getLogger(__name__)

TICK_S = 0.2  # how often None is yielded while there is no frame
FIRST_DELAY_S, LONGEST_DELAY_S = 1.0, 30.0
OPENING_TIMEOUT_S = 120.0  # of which it may spin up for a minute
RECHECK_S = 10.0  # a sensor whose packets carry no ids
SILENCE_S = 2.0  # twenty frames missing: ask the sensor why


class Phase(str, Enum):
    """What is being done about the sensor."""

    CONNECTING = "connecting"  # it is asked, set, and listened for
    WAITING = "waiting"  # the next attempt is due in a while
    RUNNING = "running"
    SILENT = "silent"  # it is open, but no frame comes

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class SensorState:
    """How it stands with a sensor, for a status page."""

    phase: Phase
    problem: str  # one line; empty where there is none
    since_ns: int  # host epoch ns: since when it runs, or since when there is this problem
    n_opened: int
    sensor: Sensor | None  # as it was last opened


class KeptSource:
    """Frames of a sensor for as long as the program runs; None about five times a second while there are none.

    address: host name or IP, optionally with the HTTP port. stop: ends the iteration. first_delay_s,
    longest_delay_s: between two attempts to open it, doubled each time. silence_s: without packets, until the
    sensor is asked. Raises nothing for what the sensor or the network does.
    """

    def __init__(
        self,
        address: str,
        wish: SensorWish,
        stop: threading.Event,
        first_delay_s: float = FIRST_DELAY_S,
        longest_delay_s: float = LONGEST_DELAY_S,
        silence_s: float = SILENCE_S,
    ):
        self._address, self._wish, self._stop = address, wish, stop
        self._first_delay_s, self._longest_delay_s, self._silence_s = first_delay_s, longest_delay_s, silence_s
        self.losses: Counter = Counter()  # Loss -> how often, over all openings
        self.state = SensorState(Phase.CONNECTING, "", time.time_ns(), 0, None)
        self._first_frame_s: float | None = None  # since it was last opened, host's monotonic clock
        self._telemetry = TelemetryPoller(SensorHttp(address), self._is_open, stop)

    @property
    def telemetry(self) -> Telemetry | None:
        """The sensor's health as it told it last; None while it is not open."""
        return self._telemetry.latest

    def __iter__(self) -> Iterator[Frame | None]:
        delay_s = self._first_delay_s
        while not self._stop.is_set():
            self._first_frame_s = None
            try:
                with (yield from self._open()) as live:
                    yield from self._read(live)
            except DriverError as error:
                if self._stop.is_set():
                    return
                self._tell(Phase.WAITING, str(error))
                if self._ran_well(error):
                    delay_s = self._first_delay_s
            yield from self._wait(delay_s)
            delay_s = min(2 * delay_s, self._longest_delay_s)

    def _open(self) -> Generator[None, None, LiveSource]:
        """Opens the sensor, which may take a minute, in a thread of its own."""
        self._tell(Phase.CONNECTING, self.state.problem)
        opening = _in_background(
            lambda: LiveSource(self._address, stop=self._stop, wish=self._wish, losses=self.losses)
        )
        deadline_s = time.monotonic() + OPENING_TIMEOUT_S
        while not opening.done():
            yield None
            wait([opening], TICK_S)
            if self._stop.is_set() or time.monotonic() > deadline_s:
                opening.add_done_callback(_close)
                raise SensorUnavailable(f"sensor {self._address} was not opened within {OPENING_TIMEOUT_S:g} s")
        live = opening.result()
        self.state = replace(self.state, n_opened=self.state.n_opened + 1, sensor=live.sensor)
        return live

    def _read(self, live: LiveSource) -> Iterator[Frame | None]:
        """Frames, until the sensor must be opened again, which is raised, or until stopped."""
        faults, inquiry = FaultWatch(self.losses), self._inquiry(live)
        recheck = _Inquiry(inquiry.ask, "", RECHECK_S, RECHECK_S)
        heard_s = time.monotonic()
        for frame in live.listen():
            if frame is not None:
                self._first_frame_s = self._first_frame_s or time.monotonic()
                if self.state.phase is not Phase.RUNNING:
                    inquiry = self._inquiry(live)
                if not live.has_ids:
                    recheck.problem()  # of a restart, which its packets do not tell; whether it answers is no matter
                self._tell(Phase.RUNNING, faults.problem() or live.strangers.problem())
            elif time.monotonic() - heard_s > self._silence_s:
                why = [inquiry.problem(), live.strangers.problem()]  # a relay may send with an address of its own
                self._tell(Phase.SILENT, faults.problem() or "; ".join(filter(None, why)))
            yield frame
            if frame is not None:
                heard_s = time.monotonic()  # only now: a reader may take long for a frame

    def _ran_well(self, end: DriverError) -> bool:
        """Whether the sensor gave frames until this end; for long enough, where another client took it.

        Two clients that take the stream from each other at once would keep it from both.
        """
        if self._first_frame_s is None:
            return False
        return not isinstance(end, SensorTaken) or time.monotonic() - self._first_frame_s > self._longest_delay_s

    def _inquiry(self, live: LiveSource) -> "_Inquiry":
        our_address = live.route[1]
        return _Inquiry(
            lambda: self._require_as_opened(live.route, live.sensor.init_id),
            f"sensor {self._address} sends nothing to UDP port {live.port} of {our_address}, as far as it gets here: "
            "check cable and firewall",
            self._first_delay_s,
            self._longest_delay_s,
        )

    def _require_as_opened(self, route: tuple[str, str], init_id: int) -> None:
        """Raises SensorChanged where the sensor must be opened again, SensorUnavailable where it does not answer."""
        if resolve(self._address) != route:
            raise SensorChanged(f"sensor {self._address}, or this machine, has another IP address now")
        require_unchanged(SensorHttp(self._address), self._wish, route[1], init_id)

    def _is_open(self) -> bool:
        return self.state.phase in (Phase.RUNNING, Phase.SILENT)

    def _wait(self, delay_s: float) -> Iterator[None]:
        until = time.monotonic() + delay_s
        while (left := until - time.monotonic()) > 0 and not self._stop.wait(min(left, TICK_S)):
            yield None

    def _tell(self, phase: Phase, problem: str) -> None:
        """Changes the state; what is new is logged, but not each attempt."""
        before = self.state
        running = phase is Phase.RUNNING
        if problem == before.problem and running == (before.phase is Phase.RUNNING):
            self.state = replace(before, phase=phase)
            return
        self.state = replace(before, phase=phase, problem=problem, since_ns=time.time_ns())
        if problem:
            logger.warning("sensor %s: %s", phase, problem)
        elif running:
            logger.info("sensor %s runs: %s %s", self._address, before.sensor.product, before.sensor.mode)


class _Inquiry:
    """Asks a sensor that is silent, at growing intervals, what is the matter."""

    def __init__(self, ask: Callable[[], None], nothing_wrong: str, first_delay_s: float, longest_delay_s: float):
        self.ask = ask
        self._delay_s, self._longest_delay_s = first_delay_s, longest_delay_s
        self._problem = self._nothing_wrong = nothing_wrong
        self._asked: Future | None = None
        self._due_s = 0.0

    def problem(self) -> str:
        """What it said last. Raises SensorChanged where it must be opened again."""
        if self._asked is None and time.monotonic() >= self._due_s:
            self._asked = _in_background(self.ask)
        elif self._asked is not None and self._asked.done():
            error, self._asked = self._asked.exception(), None
            if error is not None and (isinstance(error, SensorChanged) or not isinstance(error, DriverError)):
                raise error
            self._problem = str(error) if error else self._nothing_wrong
            self._due_s = time.monotonic() + self._delay_s
            self._delay_s = min(2 * self._delay_s, self._longest_delay_s)
        return self._problem


def _in_background(function: Callable[[], Any]) -> Future:
    """The function's result to be; its thread holds up no exit of the program."""
    future: Future = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="sensor HTTP", daemon=True).start()
    return future


def _close(opening: Future) -> None:
    if opening.exception() is None:
        opening.result().close()
