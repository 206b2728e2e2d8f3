"""The descriptor network (training only; inference runs the exported ONNX file by descriptor.py).

It reads the views of features.py and describes them in three ways, none of which a roll of the columns changes:

- shares of each cell of height and distance over all directions: alike some metres apart,
- a small convolutional network over the grid, circular in azimuth: the shape of the place,
- another one over the spectrum's directions: what is alike wherever the same things are in sight.

The networks see one sector in SECTOR_COLUMNS columns. The training takes one such set of sectors, inference all of
them: so a turn by any number of columns changes nothing.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from .features import FEATURE_SHAPES, N_HEIGHTS, N_RINGS, N_ROW_GROUPS, RING_REACH_M, SECTOR_COLUMNS
from .preprocess import N_COLUMNS

DESCRIPTOR_LENGTH = 256
N_SECTORS = N_COLUMNS // SECTOR_COLUMNS
GRID_CHANNELS = (12, 16)
RING_CHANNELS = 48
RING_DILATIONS = (1, 2, 4)
SPECTRUM_DILATIONS = (1, 2)
N_WAVES, WAVE_CHANNELS = 8, 16
DROPOUT = 0.1
OCCUPIED_GAIN = 3.0  # a third of a sector's rows in one cell fills it to two thirds
AREA_REACH_M = 45.0


class DescriptorNetwork(nn.Module):
    """grid (B, 8, 24, W), rows (B, 24, W), spectrum (B, 32, W / 2) -> (B, 256) unit vectors.

    W is N_COLUMNS, all of features.py, or N_SECTORS: one column in each SECTOR_COLUMNS.
    """

    def __init__(self):
        super().__init__()
        self.shares = Shares()
        self.grid = GridNetwork()
        self.spectrum = RingNetwork(FEATURE_SHAPES["spectrum"][0], N_SECTORS // 2, SPECTRUM_DILATIONS)
        n = self.shares.n_outputs + self.grid.n_outputs + self.spectrum.n_outputs + FEATURE_SHAPES["spectrum"][0]
        # Linear: a hidden layer here learns the training worlds by heart, and ranks new ones worse.
        self.head = nn.Sequential(nn.BatchNorm1d(n), nn.Dropout(DROPOUT), nn.Linear(n, DESCRIPTOR_LENGTH))

    def forward(self, grid: torch.Tensor, rows: torch.Tensor, spectrum: torch.Tensor) -> torch.Tensor:
        filled = 1.0 - torch.exp(-OCCUPIED_GAIN * grid)
        described = (
            self.shares(grid, filled, rows),
            self.grid(filled, rows),
            self.spectrum(spectrum),
            spectrum.mean(2),
        )
        return functional.normalize(self.head(torch.cat(described, dim=1)), dim=1, eps=1e-6)


class Shares(nn.Module):
    """What there is at each height and distance, whatever its direction; nothing is learned here."""

    n_outputs = 2 * N_HEIGHTS * N_RINGS + 6 * N_ROW_GROUPS + N_HEIGHTS

    def __init__(self):
        super().__init__()
        rings_m = torch.logspace(*np.log10(RING_REACH_M), N_RINGS)
        # The area of a ring's cell, and some for what is hidden behind: surfaces count alike from near and from far.
        self.register_buffer("area", rings_m**1.5 / 100.0 * (rings_m < AREA_REACH_M), persistent=False)

    def forward(self, grid: torch.Tensor, filled: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        mean = filled.mean(3)
        parts = (
            torch.sqrt(grid.mean(3) + 1e-3),
            _spread(mean, (filled * filled).mean(3)),
            rows.mean(2),
            _spread(rows.mean(2), (rows * rows).mean(2)),
            torch.sqrt((mean * self.area).sum(2) + 1e-3),
        )
        return torch.cat([part.flatten(1) for part in parts], dim=1)


class GridNetwork(nn.Module):
    """Convolutions over rings and sectors, then over sectors alone."""

    def __init__(self):
        super().__init__()
        few, more = GRID_CHANNELS
        self.over_rings = nn.Sequential(
            CircularConv(N_HEIGHTS, few, (3, 3), ring_step=2),
            nn.ReLU(),
            CircularConv(few, more, (3, 3), ring_step=2),
            nn.ReLU(),
        )
        self.around = RingNetwork(more * N_RINGS // 4 + 3 * N_ROW_GROUPS, N_SECTORS, RING_DILATIONS, N_WAVES)
        self.n_outputs = self.around.n_outputs

    def forward(self, filled: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        sectors = self.over_rings(_every_set(filled, N_SECTORS))
        sets = torch.cat((sectors.flatten(1, 2), _every_set(rows, N_SECTORS)), dim=1)
        return self.around.pooled(sets, len(filled))


class RingNetwork(nn.Module):
    """Residual circular convolutions over a ring of sectors, and what of them a turn does not change."""

    def __init__(self, n_inputs: int, n_sectors: int, dilations: tuple[int, ...], n_waves: int = 0):
        super().__init__()
        self.n_sectors = n_sectors
        self.enter = nn.Sequential(CircularConv(n_inputs, RING_CHANNELS, (1, 3)), nn.ReLU())
        self.blocks = nn.ModuleList([Residual(RING_CHANNELS, dilation) for dilation in dilations])
        self.n_outputs = 3 * RING_CHANNELS + n_waves * WAVE_CHANNELS
        self.waves = Waves(n_waves) if n_waves else None

    def forward(self, ring: torch.Tensor) -> torch.Tensor:
        """(B, n_inputs, all columns or one set of sectors) -> (B, n_outputs)."""
        return self.pooled(_every_set(ring, self.n_sectors), len(ring))

    def pooled(self, sets: torch.Tensor, n_scans: int) -> torch.Tensor:
        """(B * sets, n_inputs, sectors) -> (B, n_outputs): statistics over all sectors of all sets of a scan."""
        y = self.enter(sets[:, :, None])
        for block in self.blocks:
            y = block(y)
        y = y[:, :, 0]
        by_scan = (-1, n_scans)
        mean = y.mean(2).unflatten(0, by_scan).mean(0)
        square = (y * y).mean(2).unflatten(0, by_scan).mean(0)
        parts = [mean, y.amax(2).unflatten(0, by_scan).amax(0), _spread(mean, square)]
        if self.waves is not None:
            parts.append(self.waves(y).unflatten(0, by_scan).mean(0))
        return torch.cat(parts, dim=1)


class Waves(nn.Module):
    """Amplitudes of the first waves around the ring, of some mixtures of its channels."""

    def __init__(self, n_waves: int):
        super().__init__()
        angle = torch.arange(1, n_waves + 1) * (torch.arange(N_SECTORS)[:, None] * (2 * np.pi / N_SECTORS))
        waves = torch.cat((torch.cos(angle), torch.sin(angle)), dim=1) * (2.0 / N_SECTORS)
        self.register_buffer("waves", waves, persistent=False)
        self.mix = nn.Conv1d(RING_CHANNELS, WAVE_CHANNELS, 1)

    def forward(self, ring: torch.Tensor) -> torch.Tensor:
        cosine, sine = (self.mix(ring) @ self.waves).chunk(2, dim=-1)
        return torch.sqrt(cosine * cosine + sine * sine + 1e-4).flatten(1)


class CircularConv(nn.Module):
    """Convolution over (rings, sectors): circular over sectors, zeros beyond the first and last ring; normalised."""

    def __init__(self, n_in: int, n_out: int, kernel: tuple[int, int], ring_step: int = 1, dilation: int = 1):
        super().__init__()
        self.margin = (kernel[1] // 2) * dilation
        padding = (kernel[0] // 2, 0)
        self.conv = nn.Conv2d(n_in, n_out, kernel, (ring_step, 1), padding, (1, dilation), bias=False)
        self.norm = nn.BatchNorm2d(n_out)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.margin:
            x = torch.cat((x[..., -self.margin :], x, x[..., : self.margin]), dim=-1)
        return self.norm(self.conv(x))


class Residual(nn.Module):
    """A block that adds to its input."""

    def __init__(self, channels: int, dilation: int):
        super().__init__()
        self.wide = CircularConv(channels, channels, (1, 3), dilation=dilation)
        self.point = CircularConv(channels, channels, (1, 1))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(x + self.point(functional.relu(self.wide(x))))


def _every_set(columns: torch.Tensor, n: int) -> torch.Tensor:
    """(B, ..., sets * n) -> (sets * B, ..., n): each set of n sectors by itself, its sectors evenly spaced."""
    return torch.cat(columns.unflatten(-1, (n, -1)).unbind(-1))


def _spread(mean: torch.Tensor, square: torch.Tensor) -> torch.Tensor:
    """Standard deviation from the means of x and of x squared, smooth at 0."""
    return (square - mean * mean).clamp(min=1e-4).sqrt()
