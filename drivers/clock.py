"""Whether the sensor's clock goes on as its frames do: steps, restarts, and another sensor in its place."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from .frame import Frame

MOST_FRAMES = 1000  # by which ids can be held against times; more missing ones than that were restarted, not lost
FRAME_IDS = 1 << 16  # after which ids come round
HALF_A_PERIOD = 0.5  # a step below moves nothing that is compared
HOST_TOLERANCE_S = 1.0  # packets wait up to a second before they are read
DRIFT = 0.02  # by which clocks, or a motor, may be off
CONFIRMED = 3  # frames in a row on a new time; one alone has a damaged stamp, or came late


class Course(Enum):
    """How the last frame's time lies to those before."""

    GOES_ON = "goes on"
    DOUBTFUL = "doubtful"  # beside the frames before; the next ones tell whether the clock stepped
    BROKEN = "broken"  # this frame begins a time of its own


@dataclass(frozen=True)
class _Mark:
    """When a frame was, by all that tells time."""

    source: tuple  # what a session must not mix
    frame_id: int
    start_ns: int  # sensor clock, of the rotation's column 0
    host_ns: int
    period_ns: int


class ClockWatch:
    """Follows the frames of a source, in order."""

    def __init__(self) -> None:
        self._last: _Mark | None = None
        self._doubtful: list[_Mark] = []
        self.reason = ""  # of the last break, one line

    def check(self, frame: Frame) -> Course:
        """frame: one with whole column times."""
        mark = _mark(frame)
        step_ns = self._step_ns(mark)
        if step_ns == 0:
            self._follow(mark)
            return Course.GOES_ON
        if step_ns is None:
            self.reason = "the sensor was restarted, reconfigured, or is another one"
            self._follow(mark)
            return Course.BROKEN
        if self._doubtful and _step_ns(self._doubtful[-1], mark) != 0:
            self._doubtful.clear()
        self._doubtful.append(mark)
        if len(self._doubtful) < CONFIRMED:
            return Course.DOUBTFUL
        self.reason = f"the sensor's clock stepped by {step_ns * 1e-9:+.3f} s"
        self._follow(mark)
        return Course.BROKEN

    def _step_ns(self, mark: _Mark) -> int | None:
        """From the last frame that was believed; None where that was of another source."""
        if self._last is None:
            return 0
        return _step_ns(self._last, mark) if mark.source == self._last.source else None

    def _follow(self, mark: _Mark) -> None:
        self._last = mark
        self._doubtful.clear()


def _mark(frame: Frame) -> _Mark:
    sensor = frame.sensor
    columns = np.flatnonzero(frame.column_valid)
    column = int(columns[len(columns) // 2])
    start_ns = int(frame.column_ns[column]) - column * sensor.frame_period_ns // len(frame.column_ns)
    source = (sensor.serial, sensor.init_id, sensor.digest, sensor.profile)
    return _Mark(source, frame.frame_id, start_ns, frame.host_ns, sensor.frame_period_ns)


def _step_ns(before: _Mark, after: _Mark) -> int:
    """By how much more time passed on the sensor's clock than by its frame ids, or, where those do not tell, by the
    host's clock; 0 where they agree."""
    passed_ns = after.start_ns - before.start_ns
    frames = (after.frame_id - before.frame_id) % FRAME_IDS
    if 0 < frames <= MOST_FRAMES:
        expected_ns, tolerance_ns = frames * after.period_ns, HALF_A_PERIOD * after.period_ns
    else:
        expected_ns = after.host_ns - before.host_ns
        tolerance_ns = HOST_TOLERANCE_S * 1e9 if passed_ns > 0 else 0
    step_ns = passed_ns - expected_ns
    return step_ns if abs(step_ns) > tolerance_ns + DRIFT * abs(expected_ns) else 0
