"""The descriptor network (training only; inference runs the exported ONNX file by descriptor.py).

Fixed statistics of the scan's geometry, then a learned head. Turning the sensor rolls the input's columns,
and every statistic is a sum, a maximum, a sorted list or a Fourier amplitude over the columns: none of them
changes. The statistics are chosen so that scans of one place taken some metres apart have similar ones
(surfaces by height, distances between obstacles), the head learns which of them tell overlap. Training
takes minutes on one core. A small convolutional network was tried for 200 to 400 steps only (some minutes
each) and was worse at that point; it was not trained to the end, so this says nothing about what it would
reach.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from .preprocess import LOG_RANGE_GAIN, N_COLUMNS, N_ROWS, row_elevation_rad

DESCRIPTOR_LENGTH = 256
N_WAVES = 16
# Heights relative to the sensor, metres, between which the nearest surface of each column is an obstacle's.
LAYERS_M = ((-0.7, 0.6), (0.6, 2.5), (2.5, 7.0))
FAR_M = 90.0  # stands for "no obstacle"
OFFSETS = (1, 2, 3, 5, 8, 12, 18, 26, 37, 50, 64, 80, 96, 112, 128)  # columns between two obstacle points
QUANTILES = 16
AREA_REACH_M = 50.0


class Statistics(nn.Module):
    """(B, 3, 32, 256) inputs of preprocess.py -> (B, N_STATISTICS), unchanged by a roll of the columns."""

    def __init__(self):
        super().__init__()
        elevation = torch.from_numpy(row_elevation_rad()).float()[:, None]
        turn = torch.arange(N_COLUMNS) * (2 * np.pi / N_COLUMNS)
        bounds = torch.tensor(LAYERS_M)[:, :, None, None]
        for name, value in {
            "sine": torch.sin(elevation),
            "cosine": torch.cos(elevation),
            "waves": _fourier_basis(),
            "heading": torch.stack((torch.cos(turn), torch.sin(turn))),
            "low": bounds[:, 0],
            "high": bounds[:, 1],
            "log_ranges": torch.linspace(0.5, 4.7, 16),
            "heights": torch.linspace(-1.2, 3.4, 16),  # of _squashed(metres)
            "area_heights": torch.linspace(-1.6, 3.4, 24),
            "log_reaches": torch.linspace(0.8, 4.6, 14),
            "log_gaps": torch.linspace(-1.5, 4.5, 16),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        log_range, hits, looked = x[:, 0] / LOG_RANGE_GAIN, x[:, 1], x[:, 2]
        ranges = torch.exp(log_range)
        height, reach = ranges * self.sine, ranges * self.cosine
        # What was not looked at is left out of every mean, so that lost columns change little.
        scale = N_ROWS * N_COLUMNS / looked.sum((1, 2)).clamp(min=1.0)[:, None]
        seen = hits * scale[:, :, None]
        obstacles = self._obstacles(hits, height, reach)
        parts = (
            self._ranges_by_row(log_range, seen),
            self._spin_image(height, reach, seen),
            self._area_by_height(height, ranges, hits),
            (seen.mean(2), looked.mean(2)),
            (self._wave_amplitudes(torch.stack((x[:, 0] * hits, hits), dim=1).unflatten(2, (16, 2)).mean(3)),),
            self._obstacle_shape(obstacles),
        )
        return torch.cat([part.flatten(1) for group in parts for part in group], dim=1)

    def _ranges_by_row(self, log_range: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Share of each pair of rows that lies in each bin of range."""
        binned = _binned(log_range, self.log_ranges) * seen[..., None]
        return (torch.sqrt(binned.unflatten(1, (16, 2)).mean((2, 3)) + 1e-4),)

    def _spin_image(self, height: torch.Tensor, reach: torch.Tensor, seen: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Share of the returns in each bin of height and horizontal distance."""
        by_height = (_binned(_squashed(height), self.heights) * seen[..., None]).flatten(1, 2)
        by_reach = _binned(torch.log(reach), self.log_reaches).flatten(1, 2)
        spin = by_height.transpose(1, 2) @ by_reach / (N_ROWS * N_COLUMNS)
        return spin.mul(30.0), torch.sqrt(spin + 1e-5).mul(8.0)

    def _area_by_height(
        self, height: torch.Tensor, ranges: torch.Tensor, hits: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Share of the surface (not of the returns) at each height: alike from near and from far."""
        area = hits * (ranges.clamp(max=AREA_REACH_M) ** 2) * (ranges < AREA_REACH_M)
        by_height = (_binned(_squashed(height), self.area_heights) * area[..., None]).sum((1, 2))
        total = by_height.sum(1, keepdim=True)
        return torch.sqrt(by_height / (total + 1.0)), torch.log(total + 1.0) / 10

    def _wave_amplitudes(self, rings: torch.Tensor) -> torch.Tensor:
        """Amplitudes of the first waves around the ring of columns, of any (..., N_COLUMNS)."""
        cosine, sine = (rings @ self.waves).chunk(2, dim=-1)
        return torch.sqrt(cosine * cosine + sine * sine + 1e-6)

    def _obstacles(self, hits: torch.Tensor, height: torch.Tensor, reach: torch.Tensor) -> torch.Tensor:
        """(B, layers, N_COLUMNS) horizontal distance to the nearest surface in each layer, FAR_M where none."""
        inside = (height[:, None] >= self.low) & (height[:, None] < self.high) & (hits[:, None] > 0)
        return torch.where(inside, reach[:, None], torch.full_like(reach[:, None], FAR_M)).amin(2).clamp(0.5, FAR_M)

    def _obstacle_shape(self, obstacles: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Of each layer: sorted distances, wave amplitudes, and how far obstacles are from one another."""
        log_reach = torch.log(obstacles)
        step = N_COLUMNS // QUANTILES
        ordered = torch.sort(log_reach, dim=2).values[..., step // 2 :: step]
        near = torch.exp(-obstacles / 15.0)
        points = obstacles[:, :, None] * self.heading
        is_there = (obstacles < FAR_M).float()
        apart = []
        for offset in OFFSETS:
            gap = (points - _rolled(points, offset)).square().sum(2).clamp(min=1e-4).log() / 2
            both = is_there * _rolled(is_there, offset)
            apart.append((_binned(gap, self.log_gaps) * both[..., None]).mean(2))
        shares = torch.stack(apart, dim=2)
        return ordered, self._wave_amplitudes(near), is_there.mean(2), torch.sqrt(shares + 1e-4)


class DescriptorNetwork(nn.Module):
    """(B, 3, 32, 256) input of preprocess.py -> (B, 256) unit vectors: `statistics`, then `head`."""

    def __init__(self, hidden: int = 512):
        super().__init__()
        self.statistics = Statistics()
        n = self.statistics(torch.zeros(1, 3, N_ROWS, N_COLUMNS)).shape[1]
        self.register_buffer("mean", torch.zeros(n))
        self.register_buffer("spread", torch.ones(n))
        self.layers = nn.Sequential(
            nn.Dropout(0.2),
            nn.Linear(n, hidden),
            nn.ReLU(),
            nn.Dropout(0.2),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, DESCRIPTOR_LENGTH),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.head(self.statistics(x))

    def standardise(self, statistics: torch.Tensor) -> None:
        """Sets the head's scale of each statistic from those of the training scans, (M, N_STATISTICS)."""
        self.mean.copy_(statistics.mean(0))
        self.spread.copy_(statistics.std(0).clamp(min=0.01))

    def head(self, statistics: torch.Tensor) -> torch.Tensor:
        """(B, N_STATISTICS) -> (B, 256) unit vectors."""
        standard = ((statistics - self.mean) / self.spread).clamp(-4.0, 4.0)
        return functional.normalize(self.layers(standard), dim=1, eps=1e-6)


def _binned(values: torch.Tensor, centres: torch.Tensor) -> torch.Tensor:
    """(...,) -> (..., n): how much of each value falls into each of the evenly spaced, overlapping bins."""
    per_step = 1.0 / (centres[1] - centres[0])
    return functional.relu(1.0 - ((values * per_step)[..., None] - centres * per_step).abs())


def _squashed(height: torch.Tensor) -> torch.Tensor:
    """Metres near the sensor's height, logarithmic away from it."""
    return torch.sign(height) * torch.log1p(height.abs())


def _rolled(x: torch.Tensor, columns: int) -> torch.Tensor:
    return torch.cat((x[..., columns:], x[..., :columns]), dim=-1)


def _fourier_basis() -> torch.Tensor:
    """(N_COLUMNS, 2 N_WAVES): cosines, then sines, of 1..N_WAVES turns around the ring, unit gain."""
    turns = np.outer(np.arange(N_COLUMNS), np.arange(1, N_WAVES + 1)) * (2 * np.pi / N_COLUMNS)
    return torch.from_numpy(np.concatenate((np.cos(turns), np.sin(turns)), axis=1) * (2 / N_COLUMNS)).float()
