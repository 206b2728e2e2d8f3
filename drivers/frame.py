"""One rotation of the sensor, as the rest of the program sees it: plain numpy, whatever the source."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """Everything the program needs of one sensor's metadata: H beams, W columns (measurement ids) a turn."""

    serial: str
    product: str
    firmware: str
    profile: str  # of the lidar packets, e.g. "RNG19_RFL8_SIG16_NIR16"
    mode: str  # columns x rotations/s, e.g. "1024x10"
    init_id: int  # changes when the sensor restarts or is reconfigured; 0 where the packets carry none
    timestamp_mode: str  # what its clock follows: "TIME_FROM_INTERNAL_OSC" counts from its power-up
    metadata: str  # the sensor's own JSON, as given
    digest: str  # 16 hex digits; equal digests = equal geometry
    frame_period_ns: int
    column_window: tuple[int, int]  # first and last valid measurement id, inclusive; wraps when first > last
    pixel_shift: np.ndarray  # (H,) int32, columns by which each row is moved when destaggered
    altitude_rad: np.ndarray  # (H,) float32, beam altitude angles as in the metadata (row 0 = top beam)
    direction: np.ndarray  # (H, W, 3) float32 unit vectors, sensor frame, staggered
    offset: np.ndarray  # (H, W, 3) float32 metres, sensor frame, staggered

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W): beams, columns."""
        return self.direction.shape[:2]

    @cached_property
    def lidar_origin(self) -> np.ndarray:
        """(3,) float64 metres, sensor frame: the middle of the places that the beams leave from."""
        return self.offset.reshape(-1, 3).mean(axis=0, dtype=np.float64)

    @cached_property
    def in_window(self) -> np.ndarray:
        """(W,) bool: the columns that the sensor sends."""
        first, last = self.column_window
        column = np.arange(self.shape[1])
        if first <= last:
            return (column >= first) & (column <= last)
        return (column >= first) | (column <= last)

    def points(self, range_mm: np.ndarray) -> np.ndarray:
        """range_mm: (H, W), staggered -> (H, W, 3) float32 metres, sensor frame (x forward, z up).

        Extrinsics are not applied. Pixels without a return (range 0) get a meaningless point: mask them.
        """
        range_m = np.multiply(range_mm, np.float32(1e-3), dtype=np.float32)
        return range_m[..., None] * self.direction + self.offset

    def destagger(self, image: np.ndarray) -> np.ndarray:
        """image: (H, W, ...) by measurement id -> the same shape, with the columns aligned by azimuth."""
        return image[self._staggered_index]

    @cached_property
    def _staggered_index(self) -> tuple[np.ndarray, np.ndarray]:
        height, width = self.shape
        column = (np.arange(width)[None, :] - self.pixel_shift[:, None]) % width
        return np.arange(height)[:, None], column


@dataclass(frozen=True, eq=False, repr=False)
class Frame:
    """One rotation, staggered: column i holds what was measured at measurement id i."""

    sensor: Sensor
    frame_id: int
    range_mm: np.ndarray  # (H, W) uint32; 0 = no return, or the column was lost
    reflectivity: np.ndarray  # (H, W) uint8; 0 where the profile has none
    column_ns: np.ndarray  # (W,) int64, sensor clock; 0 where the column was lost
    column_valid: np.ndarray  # (W,) bool
    host_ns: int  # host epoch ns at which the last packet arrived (or was captured)

    @property
    def stamp_ns(self) -> int:
        """Sensor time of the last valid column, ns: the odometry's pose is there.

        Raises ValueError where no column is valid.
        """
        return int(self.column_ns[self.column_valid].max())

    @property
    def clock_offset_ns(self) -> int:
        """The host's clock less the sensor's, ns; it contains the packet's way here."""
        return self.host_ns - self.stamp_ns

    @property
    def valid_ratio(self) -> float:
        """Valid columns over the columns of the sensor's window, 0..1."""
        window = self.sensor.in_window
        return float(np.count_nonzero(self.column_valid & window) / np.count_nonzero(window))
