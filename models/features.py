"""From the resampled image to what the network reads: three views of one scan, each of which a turn only rolls.

``grid``: how much stands in each cell of height and distance, by azimuth, as seen from above.
``rows``: returns, nearness and what was looked at, by elevation and azimuth.
``spectrum``: amplitudes of the two-dimensional Fourier transform of what stands around, by direction. A move of the
sensor changes only the phases of that transform, a turn only its directions: what is in sight from two places has
nearly the same amplitudes, however the sensor faces. It is computed in polar coordinates (a Hankel transform of each
harmonic), so that turns by a column are exact.
"""

from __future__ import annotations

import numpy as np
from scipy.special import jv

from .preprocess import LOG_RANGE_GAIN, N_COLUMNS, row_elevation_rad

N_RINGS, N_HEIGHTS = 24, 8
RING_REACH_M = (2.0, 75.0)  # horizontal distances of the first and the last ring, evenly spaced in their logarithm
HEIGHT_REACH = (-1.4, 2.6)  # of _squashed(metres), relative to the sensor: from 3 m below to 12 m above
SECTOR_COLUMNS = 4  # a sector is a triangle of twice so many columns: turns by less move it smoothly
MIN_LOOKED = 0.25  # of a sector: what lost columns hid is filled in, but not from less
N_ROW_GROUPS = 8
NEARNESS_M = 15.0  # ranges r enter rows as exp(-r / NEARNESS_M): bounded, and 0 where nothing is

LAYER_HEIGHTS_M = np.array([-0.2, 1.2, 3.0, 6.0])  # relative to the sensor: between them a point counts for both
LAYER_REACH_M = (-1.0, 9.0)
GROUND_FADE_M = 0.5  # above the lowest height, where points begin to count
N_REACHES = 48  # metres: the plan's horizontal distances
PLAN_SIGMA_M = 22.0  # what is farther counts less
WAVELENGTH_M = np.array([80.0, 56.0, 40.0, 28.0, 20.0, 14.0, 10.0, 7.0])
N_HARMONICS = 32
N_DIRECTIONS = N_COLUMNS // 2  # the amplitudes are the same in opposite directions
AMPLITUDE_FLOOR = 0.01

FEATURE_SHAPES = {
    "grid": (N_HEIGHTS, N_RINGS, N_COLUMNS),
    "rows": (3 * N_ROW_GROUPS, N_COLUMNS),
    "spectrum": (len(LAYER_HEIGHTS_M) * len(WAVELENGTH_M), N_DIRECTIONS),
}
_ELEVATION = row_elevation_rad().astype(np.float32)


def features(image: np.ndarray) -> dict[str, np.ndarray]:
    """FEATURE_SHAPES float32 of one image of preprocess.py, INPUT_SHAPE; rolling it by a column rolls them by one."""
    row, column = np.nonzero(image[1] > 0)
    range_m = np.exp(image[0, row, column] / LOG_RANGE_GAIN)
    share = image[1, row, column]
    reach_m, height_m = range_m * np.cos(_ELEVATION)[row], range_m * np.sin(_ELEVATION)[row]
    looked = _sectors(image[2].max(axis=0))
    return {
        "grid": _grid(reach_m, height_m, column, share) / np.maximum(looked, MIN_LOOKED),
        "rows": _rows(image),
        "spectrum": _spectrum(reach_m, height_m, column, share),
    }


def _grid(reach_m: np.ndarray, height_m: np.ndarray, column: np.ndarray, share: np.ndarray) -> np.ndarray:
    low, high = np.log(RING_REACH_M)
    ring = (np.log(reach_m) - low) * ((N_RINGS - 1) / (high - low))
    low, high = HEIGHT_REACH
    height = (np.clip(_squashed(height_m), low, high) - low) * ((N_HEIGHTS - 1) / (high - low))
    near = (ring >= 0) & (ring < N_RINGS - 1)
    ring, height, column, share = ring[near], height[near], column[near], share[near]
    i, j = ring.astype(np.intp), np.minimum(height.astype(np.intp), N_HEIGHTS - 2)
    a, b = ring - i, height - j
    cell = (j * N_RINGS + i) * N_COLUMNS + column
    cells = np.concatenate([cell + (dj * N_RINGS + di) * N_COLUMNS for dj in (0, 1) for di in (0, 1)])
    weights = np.concatenate([y * x * share for y in (1 - b, b) for x in (1 - a, a)])
    counts = np.bincount(cells, weights, N_HEIGHTS * N_RINGS * N_COLUMNS).astype(np.float32)
    return _sectors(counts.reshape(FEATURE_SHAPES["grid"]))


def _rows(image: np.ndarray) -> np.ndarray:
    hits = image[1]
    nearness = hits * np.exp(np.exp(image[0] / LOG_RANGE_GAIN) / -NEARNESS_M)
    groups = np.stack((nearness, hits, image[2])).reshape(3 * N_ROW_GROUPS, -1, N_COLUMNS).mean(axis=1)
    return _sectors(groups)


def _spectrum(reach_m: np.ndarray, height_m: np.ndarray, column: np.ndarray, share: np.ndarray) -> np.ndarray:
    low, high = LAYER_REACH_M
    near = (reach_m < N_REACHES) & (height_m > low) & (height_m < high)
    reach_m, height_m, column, share = reach_m[near], height_m[near], column[near], share[near]
    n_layers = len(LAYER_HEIGHTS_M)
    layer = np.interp(height_m, LAYER_HEIGHTS_M, np.arange(n_layers))
    j = np.minimum(layer.astype(np.intp), n_layers - 2)
    b = layer - j
    weight = share * np.minimum((height_m - low) / GROUND_FADE_M, 1.0)
    cell = (j * N_REACHES + reach_m.astype(np.intp)) * N_COLUMNS + column
    cells = np.concatenate((cell, cell + N_REACHES * N_COLUMNS))
    weights = np.concatenate(((1 - b) * weight, b * weight))
    counts = np.bincount(cells, weights, n_layers * N_REACHES * N_COLUMNS).astype(np.float32)
    # A wall counts by its length, not by how many beams meet it.
    plan = 1.0 - np.exp(-2.0 * counts.reshape(n_layers * N_REACHES, N_COLUMNS))
    cosine, sine = _transform((plan @ _HARMONICS).reshape(n_layers, N_REACHES, 2, -1))
    return np.log(AMPLITUDE_FLOOR + np.hypot(cosine, sine)).reshape(FEATURE_SHAPES["spectrum"])


def _transform(harmonics: np.ndarray) -> np.ndarray:
    """(2, layers, wavelengths, N_DIRECTIONS): real and imaginary part, from the harmonics (layers, N_REACHES, 2, M).

    An even harmonic of a real plan gives the transform's real part, an odd one its imaginary part.
    """
    by_harmonic = _HANKEL @ harmonics.transpose(3, 1, 0, 2).reshape(len(_HANKEL), N_REACHES, -1)
    by_harmonic = by_harmonic.reshape(len(_HANKEL), len(WAVELENGTH_M), -1, 2).transpose(2, 1, 3, 0)
    parts = [by_harmonic[..., parity::2].reshape(*by_harmonic.shape[:2], -1) @ _WAVES[parity] for parity in (0, 1)]
    return np.stack(parts)


def _squashed(height_m: np.ndarray) -> np.ndarray:
    """Metres near the sensor's height, logarithmic away from it."""
    return np.sign(height_m) * np.log1p(np.abs(height_m))


def _sectors(columns: np.ndarray) -> np.ndarray:
    """(..., N_COLUMNS) -> the same shape: the mean over the sector around each column, a box drawn twice."""
    margin = SECTOR_COLUMNS - 1
    padded = np.concatenate((columns[..., -margin:], columns, columns[..., :margin]), axis=-1)
    for _ in range(2):
        width = padded.shape[-1] - margin
        padded = sum(padded[..., start : start + width] for start in range(SECTOR_COLUMNS)) / SECTOR_COLUMNS
    return padded


def _column_waves(n_angles: int) -> np.ndarray:
    """(2, N_HARMONICS, n_angles): cosines and sines of the first harmonics at the first angles of the columns."""
    angle = np.arange(N_HARMONICS)[:, None] * (np.arange(n_angles) * (2 * np.pi / N_COLUMNS))
    return np.stack((np.cos(angle), np.sin(angle)))


def _hankel() -> np.ndarray:
    """(N_HARMONICS, wavelengths, N_REACHES) float32: each harmonic's transform, signs of its phase included."""
    reach_m = np.arange(N_REACHES) + 0.5
    order = np.arange(N_HARMONICS)[:, None, None]
    bessel = jv(order, (2 * np.pi / WAVELENGTH_M)[:, None] * reach_m)
    window = reach_m * np.exp(-0.5 * (reach_m / PLAN_SIGMA_M) ** 2) / 100.0
    sign = np.array([1.0, 1.0, -1.0, -1.0])[order % 4]
    doubled = np.where(order == 0, 1.0, 2.0)  # each harmonic stands for its negative one too
    return (sign * doubled * bessel * window).astype(np.float32)


_HARMONICS = (_column_waves(N_COLUMNS) / N_COLUMNS).reshape(-1, N_COLUMNS).T.astype(np.float32)
_HANKEL = _hankel()
# Cosines and sines side by side, even and odd harmonics apart.
_WAVES = [_column_waves(N_DIRECTIONS)[:, parity::2].reshape(-1, N_DIRECTIONS).astype(np.float32) for parity in (0, 1)]
