"""From any OS1's range image to the network's one fixed input: rows by elevation, columns by azimuth.

The same place gives nearly the same input through 32, 64 or 128 beams and 512, 1024 or 2048 columns: each
output row reads the two beams around its elevation, and each output column averages the sensor columns that
fall into it. Both work on inverse range, in which a plane is straight, so a sparse sensor interpolates
ground and walls rightly.
"""

from __future__ import annotations

import numpy as np

N_ROWS = 32
N_COLUMNS = 256
N_CHANNELS = 3
INPUT_SHAPE = (N_CHANNELS, N_ROWS, N_COLUMNS)
TOP_DEG = 22.5
BOTTOM_DEG = -22.5
# A row farther than this from every beam was not looked at; half the beam spacing of an OS1-32 is 0.73 deg.
MAX_BEAM_DISTANCE_DEG = 1.0
# Neighbouring beams whose ranges differ by more are on two surfaces: the nearer beam speaks alone.
MAX_SURFACE_RATIO = 1.5
# A beam without return is stood in for by a neighbour as near to the row as a beam of an OS1-32 would be.
MAX_FILL_DISTANCE_DEG = 0.75
MIN_RANGE_MM = 500.0
LOG_RANGE_GAIN = 0.2


def row_elevation_rad() -> np.ndarray:
    """(N_ROWS,) float64: the elevation at the centre of each output row, top first."""
    step = (TOP_DEG - BOTTOM_DEG) / N_ROWS
    return np.deg2rad(TOP_DEG - step * (np.arange(N_ROWS) + 0.5))


class Resampler:
    """Resamples the range images of one sensor geometry; build once per sensor, call once per scan.

    pixel_shift: (H,) int, destagger shift; altitude_rad: (H,) float, row 0 on top; n_columns: W, a multiple
    of 256.
    """

    def __init__(self, pixel_shift: np.ndarray, altitude_rad: np.ndarray, n_columns: int):
        if n_columns % N_COLUMNS:
            raise ValueError(f"range image has {n_columns} columns, want a multiple of {N_COLUMNS}")
        if len(pixel_shift) != len(altitude_rad):
            raise ValueError(f"{len(pixel_shift)} pixel shifts for {len(altitude_rad)} beam altitudes")
        self.shape = (len(altitude_rad), n_columns)
        beams, gap_deg, self._blend = _beams_around(np.asarray(altitude_rad, np.float64))
        self._in_view = (gap_deg[0] <= MAX_BEAM_DISTANCE_DEG).astype(np.float32)
        self._is_close = gap_deg[1:] <= MAX_FILL_DISTANCE_DEG
        shifts = np.asarray(pixel_shift, np.intp)[beams]
        self._column = (np.arange(n_columns) - shifts[:, :, None]) % n_columns
        self._pixel = beams[:, :, None] * n_columns + self._column

    def __call__(self, range_mm: np.ndarray) -> np.ndarray:
        """INPUT_SHAPE float32 from a staggered (H, W) range image in mm, 0 = no return.

        Channels: LOG_RANGE_GAIN * ln(range in m), 0 where empty; part of the cell's pixels with a return; 1
        where the sensor looked. A column without any return was lost on its way: it counts as not looked
        at, not as empty.
        """
        if range_mm.shape != self.shape:
            raise ValueError(f"range image is {range_mm.shape}, the sensor has {self.shape}")
        inverse = self._beam_inverse(range_mm)
        looked = _sum_per_cell((range_mm > 0).any(axis=0)[self._column[0]]) * self._in_view[:, None]
        hits = _sum_per_cell(inverse > 0) * self._in_view[:, None]
        return _channels(_sum_per_cell(inverse), hits, looked)

    def _beam_inverse(self, range_mm: np.ndarray) -> np.ndarray:
        """(N_ROWS, W) float32 inverse range, 1/m, at each row's elevation, by azimuth; 0 = empty."""
        measured_mm = range_mm.ravel().take(self._pixel).astype(np.float32)
        inverse = np.float32(1e3) / np.maximum(measured_mm, np.float32(MIN_RANGE_MM)) * (measured_mm > 0)
        near, across, behind = inverse
        same_surface = (np.maximum(near, across) <= MAX_SURFACE_RATIO * np.minimum(near, across)) & (near > 0)
        value = np.where(same_surface, near + self._blend[:, None] * (across - near), near)
        for fill, is_close in zip((across, behind), self._is_close, strict=True):
            np.copyto(value, fill, where=(value == 0) & is_close[:, None])
        return value


def _sum_per_cell(image: np.ndarray) -> np.ndarray:
    """(N_ROWS, W) of any kind -> (N_ROWS, N_COLUMNS) float32 sums over the columns of each cell."""
    return np.einsum("rck->rc", image.astype(np.float32).reshape(N_ROWS, N_COLUMNS, -1))


def _channels(inverse_sum: np.ndarray, hits: np.ndarray, looked: np.ndarray) -> np.ndarray:
    channels = np.zeros(INPUT_SHAPE, np.float32)
    filled = (hits > 0) & (looked > 0)
    np.divide(hits, inverse_sum, out=channels[0], where=filled)
    np.log(channels[0], out=channels[0], where=filled)
    channels[0] *= LOG_RANGE_GAIN
    np.divide(hits, looked, out=channels[1], where=filled)
    channels[2] = looked > 0
    return channels


def _beams_around(altitude_rad: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each row the nearest beam, the one across and the one behind, (3, N_ROWS); degrees to each; weight.

    The weight, (N_ROWS,), is that of the beam across when interpolating to the row's elevation.
    """
    rows, last = row_elevation_rad(), len(altitude_rad) - 1
    nearest = np.abs(altitude_rad[None, :] - rows[:, None]).argmin(axis=1)
    step = np.where(altitude_rad[nearest] > rows, 1, -1)
    beams = np.clip(np.stack((nearest, nearest + step, nearest - step)), 0, last)
    gap = np.abs(altitude_rad[beams] - rows)
    span = np.abs(altitude_rad[beams[1]] - altitude_rad[nearest])
    blend = np.where(span > 0, gap[0] / np.maximum(span, 1e-9), 0.0).astype(np.float32)
    return beams, np.rad2deg(gap), blend
