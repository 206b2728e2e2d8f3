"""Training batches: which scans stand side by side, and how their inputs are spoilt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .preprocess import LOG_RANGE_GAIN, N_COLUMNS, N_ROWS

WORLDS_PER_BATCH = 2
# Overlaps of the companions drawn for each anchor scan: pairs from all over the range stand in every batch.
COMPANION_OVERLAPS = ((0.7, 1.0), (0.45, 0.7), (0.2, 0.45))
MAX_LOG_SCALE = 0.3
NOISE = 0.004  # of the input's logarithmic range: 2 % of the range


@dataclass(frozen=True, eq=False)
class CachedWorld:
    """One world of the scan set, ready for training.

    inputs: (V, N, 3, 32, 256) float16, each scan through V sensors; overlap: (N, N); position_m: (N, 3);
    season: (N,).
    """

    inputs: np.ndarray
    overlap: np.ndarray
    position_m: np.ndarray
    season: np.ndarray

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) indices: anchors, each followed by one companion per range of COMPANION_OVERLAPS."""
        drawn = []
        while len(drawn) < n:
            anchor = rng.integers(len(self.overlap))
            drawn.append(anchor)
            for low, high in COMPANION_OVERLAPS:
                fitting = np.flatnonzero((self.overlap[anchor] >= low) & (self.overlap[anchor] < high))
                drawn.append(rng.choice(fitting) if fitting.size else rng.integers(len(self.overlap)))
        return np.array(drawn[:n])


def draw_batch(worlds: list[CachedWorld], rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (n, 3, 32, 256) float32, spoilt, and the overlaps (n, n) float32 of all their pairs."""
    part = n // WORLDS_PER_BATCH
    overlap = np.zeros((n, n), np.float32)  # between worlds nothing is shared
    inputs = []
    for block, world_index in enumerate(rng.choice(len(worlds), WORLDS_PER_BATCH, replace=False)):
        world = worlds[world_index]
        index = world.draw(rng, part)
        sensor = rng.integers(len(world.inputs), size=part)
        inputs.append(_reshape_world(world.inputs[sensor, index].astype(np.float32), rng))
        rows = slice(block * part, (block + 1) * part)
        overlap[rows, rows] = world.overlap[np.ix_(index, index)]
    return spoil(np.concatenate(inputs), rng), overlap


def _reshape_world(inputs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same scans in a world of another size, in half the cases mirrored: overlaps stay as they were."""
    inputs[:, 0] += (inputs[:, 1] > 0) * np.float32(
        rng.uniform(-MAX_LOG_SCALE, MAX_LOG_SCALE) * LOG_RANGE_GAIN
    )
    return np.flip(inputs, axis=3) if rng.random() < 0.5 else inputs


def spoil(inputs: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Range noise, lost returns, silent beams and lost packets on (n, 3, 32, 256) inputs, in place."""
    n = len(inputs)
    noise = rng.normal(0, NOISE, inputs[:, 0].shape).astype(np.float32)
    inputs[:, 0] += noise * (inputs[:, 1] > 0)
    lost_share = rng.uniform(0, 0.12, (n, 1, 1)) * (rng.random((n, 1, 1)) < 0.5)
    empty = rng.random((n, N_ROWS, N_COLUMNS)) < lost_share
    empty |= (rng.random((n, N_ROWS, 1)) < 0.3) & (rng.random((n, 1, 1)) < 0.15)
    # Captures re-encoded from other sensors often have nothing above the horizon.
    empty[rng.random(n) < 0.1, : rng.integers(8, 15)] = True
    inputs[:, :2] *= ~empty[:, None]
    for scan in np.flatnonzero(rng.random(n) < 0.4):
        inputs[scan][:, :, _lost_columns(rng)] = 0
    return inputs


def _lost_columns(rng: np.random.Generator) -> np.ndarray:
    """Columns of a few lost packets: a packet of 16 sensor columns covers 4 or 8 of ours."""
    width = int(rng.choice((4, 8)))
    starts = rng.integers(N_COLUMNS, size=rng.integers(1, 1 + 48 // width))
    return (starts[:, None] + np.arange(width)).ravel() % N_COLUMNS
