"""What all sources of frames have in common."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator

from ouster.sdk.core import LidarFrame

from .frame import Frame, Sensor
from .losses import Loss
from .packets import frame_from_sdk


class Source(ABC):
    """Frames of one sensor, in the order in which they were measured; read once. A context manager."""

    sensor: Sensor
    losses: Counter  # Loss -> how often, so far
    n_frames_estimate: int | None = None  # for a progress bar; None: unknown, or without end

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Yields frames as they come, partial ones too: a FrameGate judges them."""

    @abstractmethod
    def close(self) -> None:
        """Frees the file or socket. May be called twice."""

    def _frames(self, lidar_frame: LidarFrame) -> Iterator[Frame]:
        frame = frame_from_sdk(lidar_frame, self.sensor)
        if frame:
            yield frame
        else:
            self.losses[Loss.EMPTY_FRAME] += 1

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, *_exception) -> None:
        self.close()
