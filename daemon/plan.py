"""Plans: what stands upright around a place, seen from above, and where in it a scan may have been taken.

A scan's plan is laid over a place's at every heading and shift (circular correlation), so that a robot that comes
back with another heading, or in another lane, is found as well. Ground, and how it slopes, plays no part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter

FINE_M = 0.4  # cells in which the height of what stands there is taken
LOWEST_M, HIGHEST_M = 0.3, 2.3  # lower is ground; higher adds nothing, or a house would outweigh a street of trunks
CELL_M = 0.8  # of the correlated images; a cell's error is far within the registration's reach
SIZE = 144  # cells, 115 m: scans of 40 m range around a scene of 20 m hardly wrap around
MAX_WEIGHT = 4.0  # of a cell
BLUR_CELLS = 0.7
HEADINGS = 2 * np.pi / 72 * np.arange(72)
REACH_M = 12.0  # how far from the stored scans poses are looked for: a twin of the right one may lie off the path
APART_M, APART_DEG = 2.0, 20.0  # guesses nearer to each other than both are one


@dataclass(frozen=True, eq=False)
class Guess:
    """A first idea T_map_sensor (4, 4) of a scan's pose; score: how well the plans agree, 0 to 1."""

    T_map_sensor: np.ndarray
    score: float


class ScanPlan:
    """Plan of one scan at every heading. points (N, 3) float32 metres, sensor frame."""

    def __init__(self, points: np.ndarray):
        xy, weight = _upright(points)
        images = np.stack([_image(xy @ _turn(heading).T, weight) for heading in HEADINGS])
        self.spectra = rfft2(images)
        self.norm = float(np.linalg.norm(images[0]))


class PlacePlan:
    """Plan of a place. points (N, 3) float32 metres, map frame, of scans taken at T_map_scans (S, 4, 4)."""

    def __init__(self, points: np.ndarray, T_map_scans: np.ndarray):
        self._T_map_scans = T_map_scans
        centre = T_map_scans[:, :2, 3].mean(axis=0)
        xy, weight = _upright(points)
        image = gaussian_filter(_image(xy - centre, weight), BLUR_CELLS, mode="constant")
        self._spectrum = rfft2(image)
        self._norm = float(np.linalg.norm(image))
        shift = np.fft.fftfreq(SIZE, 1.0 / SIZE) * CELL_M
        positions = centre + np.stack(np.meshgrid(shift, shift, indexing="ij"), axis=-1).reshape(-1, 2)
        away = np.linalg.norm(positions[:, None] - T_map_scans[None, :, :2, 3], axis=2)
        self._cells = np.flatnonzero(away.min(axis=1) < REACH_M)
        self._positions, self._nearest = positions[self._cells], away[self._cells].argmin(axis=1)

    def guesses(self, scan: ScanPlan, n: int) -> list[Guess]:
        """The n poses at which a scan's plan fits best, no two of them alike, best first."""
        if self._norm == 0.0 or scan.norm == 0.0:
            return []
        fit = irfft2(self._spectrum * np.conj(scan.spectra), s=(SIZE, SIZE)).reshape(len(HEADINGS), -1)
        fit = fit[:, self._cells] / (self._norm * scan.norm)
        found = []
        for _ in range(n):
            heading, cell = np.unravel_index(fit.argmax(), fit.shape)
            found.append(Guess(self._pose(heading, cell), float(fit[heading, cell])))
            beside = np.linalg.norm(self._positions - self._positions[cell], axis=1) < APART_M
            turned = np.cos(HEADINGS - HEADINGS[heading]) > np.cos(np.deg2rad(APART_DEG))
            fit[np.ix_(turned, beside)] = -1.0
        return found

    def _pose(self, heading: int, cell: int) -> np.ndarray:
        """Height and tilt are those of the nearest stored scan: it stood on the same ground."""
        T = self._T_map_scans[self._nearest[cell]].copy()
        T[:3, :3] = T[:3, :3] @ _about_z(HEADINGS[heading] - np.arctan2(T[1, 0], T[0, 0]))
        T[:2, 3] = self._positions[cell]
        return T


def _upright(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells in which something stands: xy (K, 2) of their middles, metres, and its height (K,), ground taken off."""
    cell = np.floor(points[:, :2] / FINE_M).astype(np.int64)
    key = cell[:, 0] << 32 | (cell[:, 1] & 0xFFFFFFFF)
    order = np.argsort(key)
    first = np.flatnonzero(np.append(True, np.diff(key[order]) != 0)) if len(key) else order
    z = points[order, 2]
    height = (np.maximum.reduceat(z, first) - np.minimum.reduceat(z, first)) if len(key) else z
    stands = height > LOWEST_M
    middle = (cell[order[first]] + 0.5) * FINE_M
    return middle[stands], np.minimum(height[stands], HIGHEST_M) - LOWEST_M


def _image(xy: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(SIZE, SIZE) float32 of the weights (K,) at xy (K, 2), the origin in its middle."""
    cell = np.floor(xy / CELL_M).astype(np.int64) + SIZE // 2
    inside = ((cell >= 0) & (cell < SIZE)).all(axis=1)
    flat = np.bincount(cell[inside] @ [SIZE, 1], weight[inside], SIZE * SIZE)
    return np.minimum(flat, MAX_WEIGHT).reshape(SIZE, SIZE).astype(np.float32)


def _turn(angle_rad: float) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


def _about_z(angle_rad: float) -> np.ndarray:
    R = np.eye(3)
    R[:2, :2] = _turn(angle_rad)
    return R
