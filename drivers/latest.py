"""What a slow program does without: whole frames, and not a packet here and there of each."""

import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator

from .frame import Frame
from .losses import Loss

DEPTH = 3  # frames that wait; at 10 Hz what is measured is at most so many tenths of a second old
TICK_S = 0.2


class LatestFrames:
    """Reads a live source in a thread of its own, so that its packets never wait for the program.

    source: yields frames, or None. losses: where skipped frames are counted. Iterating yields frames, the oldest
    first, or None five times a second while there are none, and ends with the source; what the source raises is
    raised here.
    """

    def __init__(self, source: Iterable[Frame | None], losses: Counter):
        self._source, self._losses = source, losses
        self._frames: deque[Frame] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self._error: BaseException | None = None

    def __iter__(self) -> Iterator[Frame | None]:
        threading.Thread(target=self._read, name="frames", daemon=True).start()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._frames or self._ended, TICK_S)
                frame = self._frames.popleft() if self._frames else None
                ended = self._ended
            if frame is None and ended:
                if self._error is not None:
                    raise self._error
                return
            yield frame

    def _read(self) -> None:
        try:
            for frame in self._source:
                if frame is not None:
                    self._add(frame)
        except BaseException as error:
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _add(self, frame: Frame) -> None:
        with self._changed:
            if len(self._frames) == DEPTH:
                self._frames.popleft()
                self._losses[Loss.SKIPPED_FRAME] += 1
            self._frames.append(frame)
            self._changed.notify()
