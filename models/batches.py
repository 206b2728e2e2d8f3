"""Training batches: how inputs are spoilt, and which scans stand side by side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from .network import Statistics
from .preprocess import LOG_RANGE_GAIN, N_COLUMNS, N_ROWS
from .scan_sets import CachedWorld

WORLDS_PER_BATCH = 3
# Overlaps of the companions drawn for each anchor scan: pairs from all over the range stand in every batch.
COMPANION_OVERLAPS = ((0.7, 1.0), (0.45, 0.7), (0.2, 0.45))
NOISE = 0.02 * LOG_RANGE_GAIN  # 2 % of the range
SCANS_AT_ONCE = 8


@dataclass(frozen=True, eq=False)
class StatisticsOfWorld:
    """One world, ready for training: (V, N, S) float16, N scans in V variants; (N, N) float32 overlaps."""

    statistics: torch.Tensor
    overlap: np.ndarray

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """(n,) indices: anchors, each followed by one companion per range of COMPANION_OVERLAPS."""
        drawn: list[int] = []
        while len(drawn) < n:
            anchor = rng.integers(len(self.overlap))
            drawn.append(anchor)
            for low, high in COMPANION_OVERLAPS:
                fitting = np.flatnonzero((self.overlap[anchor] >= low) & (self.overlap[anchor] < high))
                drawn.append(rng.choice(fitting) if fitting.size else rng.integers(len(self.overlap)))
        return np.array(drawn[:n])


@torch.no_grad()
def statistics_of_worlds(worlds: Iterable[CachedWorld], spoilt: bool) -> list[StatisticsOfWorld]:
    """The statistics of every scan through every sensor and, if asked, of spoilt copies as well."""
    statistics = Statistics().eval()
    done = []
    for world in worlds:
        rng = np.random.default_rng((world.seed, 10))
        inputs = [sensor.astype(np.float32) for sensor in world.inputs]
        if spoilt:
            inputs += [spoil(sensor.copy(), rng) for sensor in inputs]
        variants = []
        for scans in inputs:
            parts = torch.from_numpy(scans).split(SCANS_AT_ONCE)
            variants.append(torch.cat([statistics(part) for part in parts]).half())
        done.append(StatisticsOfWorld(torch.stack(variants), world.overlap))
    return done


def draw_batch(worlds: list[StatisticsOfWorld], rng: np.random.Generator, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Statistics (n, S) float32 of scans of a few worlds, and the overlaps (n, n) float32 of all their pairs."""
    part = n // WORLDS_PER_BATCH
    overlap = np.zeros((n, n), np.float32)  # between worlds nothing is shared
    drawn = []
    for block, world_index in enumerate(rng.choice(len(worlds), WORLDS_PER_BATCH, replace=False)):
        world = worlds[world_index]
        index = world.draw(rng, part)
        drawn.append(world.statistics[rng.integers(len(world.statistics), size=part), index])
        rows = slice(block * part, (block + 1) * part)
        overlap[rows, rows] = world.overlap[np.ix_(index, index)]
    return torch.cat(drawn).float(), torch.from_numpy(overlap)


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
    for scan in np.flatnonzero(rng.random(n) < 0.6):
        inputs[scan][:, :, _lost_columns(rng)] = 0
    return inputs


def _lost_columns(rng: np.random.Generator) -> np.ndarray:
    """Columns of a few lost packets: a packet of 16 sensor columns covers 4 or 8 of ours."""
    width = int(rng.choice((4, 8)))
    starts = rng.integers(N_COLUMNS, size=rng.integers(1, 1 + 48 // width))
    return (starts[:, None] + np.arange(width)).ravel() % N_COLUMNS
