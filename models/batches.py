"""Training batches: how scans are spoilt, and which stand side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from .features import N_RINGS, SECTOR_COLUMNS, features
from .preprocess import LOG_RANGE_GAIN, N_COLUMNS, N_ROWS
from .scan_sets import CachedWorld

WORLDS_PER_BATCH = 2
TWINS = 0.2  # of the scans of a draw are there twice, mostly through two sensors that face differently
ONE_SENSOR = 0.5  # of the draws from a world are of scans through one sensor, the others of mixed ones
SPOILT = 0.5  # of the training scans
WINDOWED = 0.1  # of the spoilt ones: the sensor sends an azimuth window only
NOISE = 0.03 * LOG_RANGE_GAIN  # up to 3 % of the range
MAX_RING_SHIFT = 2.0  # rings of 17 %: places a third smaller or larger than the virtual ones

Features = dict[str, torch.Tensor]


@dataclass(frozen=True, eq=False)
class FeaturesOfWorld:
    """One world, ready for training: features.py's views of N scans in V variants, (V, N, ...) float16, one set of
    sectors of each; (N, N) float32 overlaps.
    """

    features: dict[str, np.ndarray]
    overlap: np.ndarray

    @property
    def n_variants(self) -> int:
        return len(self.features["rows"])

    def take(self, variant: np.ndarray | int, index: np.ndarray) -> Features:
        """float32 features of some scans."""
        return {
            name: torch.from_numpy(values[variant, index].astype(np.float32)) for name, values in self.features.items()
        }


def features_of_world(world: CachedWorld, spoilt: bool) -> FeaturesOfWorld:
    """The features of every scan through every sensor; if asked, some of them are spoilt."""
    rng = np.random.default_rng((world.seed, 10))
    variants = []
    for images in world.inputs.astype(np.float32):
        chosen = rng.random(len(images)) < (SPOILT if spoilt else 0.0)
        images[chosen] = spoil(images[chosen], rng)
        variants.append(_one_set(images, rng))
    stacked = {name: np.stack([variant[name] for variant in variants]) for name in variants[0]}
    return FeaturesOfWorld(stacked, world.overlap)


def draw_batch(worlds: list[FeaturesOfWorld], rng: np.random.Generator, n: int) -> tuple[Features, torch.Tensor]:
    """Features of n scans, as many of each of a few worlds, and the overlaps (worlds, part, part) float32 in them."""
    part = n // WORLDS_PER_BATCH
    drawn, overlaps = [], []
    for chosen in rng.choice(len(worlds), WORLDS_PER_BATCH, replace=False):
        world = worlds[chosen]
        n_twins = int(TWINS * part)
        index = rng.choice(len(world.overlap), part - n_twins, replace=len(world.overlap) < part)
        index = np.concatenate((index, index[:n_twins]))
        variant = rng.integers(world.n_variants, size=1 if rng.random() < ONE_SENSOR else part)
        drawn.append(reshape_world(world.take(variant, index), rng))
        overlaps.append(torch.from_numpy(world.overlap[np.ix_(index, index)]))
    return {name: torch.cat([some[name] for some in drawn]) for name in drawn[0]}, torch.stack(overlaps)


def reshape_world(scans: Features, rng: np.random.Generator) -> Features:
    """All scans of a draw as they would be in the world's mirror image, or in a wider or narrower one."""
    scans = dict(scans)
    if rng.random() < 0.5:
        scans = {name: values.flip(-1) for name, values in scans.items()}
    if rng.random() < 0.5:
        whole, part = divmod(rng.uniform(-MAX_RING_SHIFT, MAX_RING_SHIFT), 1.0)
        margin = int(MAX_RING_SHIFT) + 1
        padded = functional.pad(scans["grid"], (0, 0, margin, margin))
        start = margin - int(whole)
        here, before = (padded[:, :, first : first + N_RINGS] for first in (start, start - 1))
        scans["grid"] = (1 - part) * here + part * before
    return scans


def spoil(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Range noise, what is lost or not looked at, and what stands too near, on (n, 3, 32, 256), in place."""
    n = len(images)
    noise = rng.normal(0, 1, images[:, 0].shape) * rng.uniform(0, NOISE, (n, 1, 1))
    images[:, 0] += noise.astype(np.float32) * (images[:, 1] > 0)
    lost_share = rng.uniform(0, 0.15, (n, 1, 1)) * (rng.random((n, 1, 1)) < 0.5)
    empty = rng.random((n, N_ROWS, N_COLUMNS)) < lost_share
    empty |= (rng.random((n, N_ROWS, 1)) < 0.3) & (rng.random((n, 1, 1)) < 0.15)
    # Captures re-encoded from other sensors often have nothing above the horizon, and dim targets end a scan early.
    empty[rng.random(n) < 0.1, : rng.integers(6, 15)] = True
    reach_m = np.where(rng.random(n) < 0.2, rng.uniform(30, 110, n), np.inf)
    empty |= images[:, 0] > LOG_RANGE_GAIN * np.log(reach_m)[:, None, None]
    images[:, :2] *= ~empty[:, None]
    for scan in np.flatnonzero(rng.random(n) < 0.3):
        _stand_before(images[scan], rng)
    for scan in np.flatnonzero(rng.random(n) < 0.5):
        images[scan][:, :, _lost_columns(rng)] = 0
    for scan in np.flatnonzero(rng.random(n) < WINDOWED):
        images[scan][:, :, _outside_window(rng)] = 0
    return images


def _stand_before(image: np.ndarray, rng: np.random.Generator) -> None:
    """The robot's own body, or somebody beside it: a sector below some row shows only that, or nothing."""
    columns = (rng.integers(N_COLUMNS) + np.arange(rng.integers(8, 50))) % N_COLUMNS
    cells = np.ix_(range(rng.integers(4, 26), N_ROWS), columns)
    image[0][cells] = LOG_RANGE_GAIN * np.log(rng.uniform(0.6, 3.0))
    image[1][cells] = rng.random() < 0.5
    image[0][image[1] == 0] = 0
    image[:2] *= image[2]


def _lost_columns(rng: np.random.Generator) -> np.ndarray:
    """Columns of a few lost packets: a packet of 16 sensor columns covers 4 or 8 of ours."""
    width = int(rng.choice((4, 8)))
    starts = rng.integers(N_COLUMNS, size=rng.integers(1, 1 + 48 // width))
    return (starts[:, None] + np.arange(width)).ravel() % N_COLUMNS


def _outside_window(rng: np.random.Generator) -> np.ndarray:
    """Columns of all but a window of half to nearly all azimuths."""
    return (rng.integers(N_COLUMNS) + np.arange(rng.integers(N_COLUMNS // 16, N_COLUMNS // 2))) % N_COLUMNS


def _one_set(images: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """The features of (n, 3, 32, 256) images, one set of sectors of each, float16."""
    described = []
    for image, first in zip(images, rng.integers(SECTOR_COLUMNS, size=len(images)), strict=True):
        described.append({name: view[..., first::SECTOR_COLUMNS] for name, view in features(image).items()})
    return {name: np.stack([views[name] for views in described]).astype(np.float16) for name in described[0]}
