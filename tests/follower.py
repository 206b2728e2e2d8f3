"""Follows a kept source as the daemon does."""

import threading
import time
from collections.abc import Callable

from revisitd.drivers.frame import Frame
from revisitd.drivers.kept import KeptSource, Phase, SensorState
from revisitd.drivers.sensor_setup import SensorWish

PATIENCE_S = 20.0


class Follower:
    """Follows it until something is as wanted, and collects its frames."""

    def __init__(self, address: str, wish: SensorWish):
        self.stop = threading.Event()
        self.source = KeptSource(address, wish, self.stop, first_delay_s=0.05, longest_delay_s=2.0, silence_s=0.25)
        self.frames: list[Frame] = []
        self._frames = iter(self.source)

    def until(self, reached: Callable[[SensorState], bool]) -> SensorState:
        """The state once it is as wanted; a kept source must say something at least once a second."""
        deadline = time.monotonic() + PATIENCE_S
        while not reached(self.source.state):
            self._step(deadline)
        return self.source.state

    def until_running(self) -> SensorState:
        return self.until(lambda state: state.phase is Phase.RUNNING)

    def until_problem(self, part: str) -> SensorState:
        return self.until(lambda state: part in state.problem)

    def until_opened(self, times: int) -> SensorState:
        return self.until(lambda state: state.n_opened == times)

    def more_frames(self, count: int) -> list[Frame]:
        """The next frames."""
        wanted, deadline = len(self.frames) + count, time.monotonic() + PATIENCE_S
        while len(self.frames) < wanted:
            self._step(deadline)
        return self.frames[-count:]

    def close(self) -> None:
        """Stops it; it must end at once."""
        self.stop.set()
        assert len([frame for frame in self._frames if frame is None]) <= 1

    def _step(self, deadline: float) -> None:
        asked = time.monotonic()
        frame = next(self._frames)
        assert time.monotonic() - asked < 1, "for a second it said nothing"
        assert asked < deadline, self.source.state
        if frame is not None:
            self.frames.append(frame)
