"""Accepts or rejects frames: the odometry is better off without a frame than with half of one."""

from collections import Counter
from enum import Enum

import numpy as np

from .clock import ClockWatch, Course
from .errors import BadCapture
from .frame import Frame

MIN_RETURN_RATIO = 0.01  # of the pixels; with less the sensor is covered or failing, and nothing can use it
NEAREST_MM = 300  # no Ouster measures nearer: such a return is dirt on its window
MAX_SPAN_PERIODS = 1.5  # a rotation's column times spread over one period; more is a damaged time
MAX_FRAME_ID_GAP = 1000  # more missing ids than in minutes of silence: they were restarted, not lost


class Rejection(str, Enum):
    """Why a frame is not used."""

    TOO_FEW_COLUMNS = "too few columns"
    TIME_DAMAGED = "column times damaged"
    TIME_DOUBTFUL = "time out of step"
    TIME_NOT_INCREASING = "time not increasing"
    NO_RETURNS = "no returns"

    def __str__(self) -> str:
        return self.value


class FrameGate:
    """Judges the frames of one sensor in their order, and counts what is lost."""

    def __init__(self, min_valid_ratio: float = 0.9):
        self._min_valid_ratio = min_valid_ratio
        self._last_stamp_ns: int | None = None
        self._last_frame_id: int | None = None
        self._clock = ClockWatch()
        self.interruption = ""  # why the frame last checked begins a time of its own; empty where it goes on
        self.accepted = 0
        self.rejected: Counter = Counter()  # Rejection -> frames
        self.frames_missing = 0  # of which no column arrived
        self.columns_missing = 0  # in frames of which some did

    @property
    def losses(self) -> dict[str, int]:
        """What was lost, by cause."""
        missing = {"frames missing": self.frames_missing, "columns missing": self.columns_missing}
        return missing | {f"frames rejected: {reason}": count for reason, count in self.rejected.items()}

    def check(self, frame: Frame) -> Rejection | None:
        """None where the frame is good, else why it is not. Call once for each frame, in order.

        Sets `interruption` where nothing may be carried over from the frames before: the sensor's clock stepped, it
        was restarted, or it is another one.
        """
        self.interruption = ""
        self._count_missing(frame)
        rejection = self._judge(frame)
        if rejection:
            self.rejected[rejection] += 1
        else:
            self.accepted += 1
            self._last_stamp_ns = frame.stamp_ns
        return rejection

    def require_accepted(self, source: str) -> None:
        """Raises BadCapture where no frame of the source has been accepted, once it is read to its end."""
        if not self.accepted:
            reasons = ", ".join(f"{count} {reason}" for reason, count in self.rejected.items())
            raise BadCapture(
                f"{source} holds no whole frame ({reasons or 'none begun'}; "
                f"{self.columns_missing} columns missing): record at least one full turn of the sensor"
            )

    def _judge(self, frame: Frame) -> Rejection | None:
        if frame.valid_ratio < self._min_valid_ratio:
            return Rejection.TOO_FEW_COLUMNS
        if np.ptp(frame.column_ns[frame.column_valid]) > MAX_SPAN_PERIODS * frame.sensor.frame_period_ns:
            return Rejection.TIME_DAMAGED  # before it becomes the time that all later frames are held against
        course = self._clock.check(frame)
        if course is Course.BROKEN:
            self.interruption, self._last_stamp_ns = self._clock.reason, None
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            return Rejection.TIME_NOT_INCREASING
        if course is Course.DOUBTFUL:
            return Rejection.TIME_DOUBTFUL
        if np.count_nonzero(frame.range_mm >= NEAREST_MM) < MIN_RETURN_RATIO * frame.range_mm.size:
            return Rejection.NO_RETURNS
        return None

    def _count_missing(self, frame: Frame) -> None:
        window = frame.sensor.in_window
        self.columns_missing += int(np.count_nonzero(window & ~frame.column_valid))
        if self._last_frame_id is not None:
            gap = frame.frame_id - self._last_frame_id - 1
            self.frames_missing += gap if 0 < gap < MAX_FRAME_ID_GAP else 0
        self._last_frame_id = frame.frame_id
