"""The descriptor network (training only; inference runs the exported ONNX file by descriptor.py).

Exact invariance to yaw by construction: turning the sensor rolls the input's columns; every layer up to the
pooling is a circular convolution of stride 1 along the columns, so its output rolls with them; the pooling
(mean, maximum, amplitude of the Fourier series over azimuth) does not change under a roll. Rows are strided
freely.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from .preprocess import N_CHANNELS, N_COLUMNS, N_ROWS

DESCRIPTOR_LENGTH = 256


class CircularConv(nn.Module):
    """2-D convolution, circular along columns, normalised over the whole scan, ReLU."""

    def __init__(self, n_in: int, n_out: int, row_kernel: int = 3, row_stride: int = 1, row_pad: int = 1):
        super().__init__()
        self.conv = nn.Conv2d(n_in, n_out, (row_kernel, 3), (row_stride, 1), (row_pad, 0), bias=False)
        # Not batch norm: what a batch has in common depends on its worlds, and is not there at run time.
        self.norm = nn.GroupNorm(1, n_out)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.relu(self.norm(self.conv(_wrap(x, 1))))


class RingBlock(nn.Module):
    """Residual block on the ring of columns: wide depthwise convolution, then two pointwise ones."""

    def __init__(self, n: int, dilation: int, kernel: int = 5):
        super().__init__()
        self.margin = dilation * (kernel // 2)
        self.spread = nn.Conv2d(n, n, (1, kernel), dilation=(1, dilation), groups=n, bias=False)
        self.norm = nn.GroupNorm(1, n)
        self.mix = nn.Conv2d(n, n, 1)
        self.out = nn.Conv2d(n, n, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.norm(self.spread(_wrap(x, self.margin)))
        return x + self.out(functional.relu(self.mix(y)))


class DescriptorNetwork(nn.Module):
    """(B, 3, 32, 256) input of preprocess.py -> (B, 256) unit vectors."""

    def __init__(self, width: int = 96, n_waves: int = 32, wave_channels: int = 32):
        super().__init__()
        self.stem = CircularConv(N_CHANNELS, 24, row_kernel=5, row_stride=4)
        self.row_bias = nn.Parameter(torch.zeros(1, 24, N_ROWS // 4, 1))
        self.image = CircularConv(24, 48, row_stride=2)
        self.column = CircularConv(48, width, row_kernel=N_ROWS // 8, row_pad=0)
        self.ring = nn.Sequential(*(RingBlock(width, dilation) for dilation in (1, 2, 4, 8, 16, 1)))
        self.expand = nn.Conv2d(width, 2 * width, 1)
        self.to_waves = nn.Conv2d(width, wave_channels, 1)
        self.register_buffer("waves", _fourier_basis(n_waves))
        self.level_norm = nn.LayerNorm(4 * width)
        self.wave_norm = nn.LayerNorm(n_waves * wave_channels)
        n_pooled = 4 * width + n_waves * wave_channels
        self.head = nn.Sequential(nn.Linear(n_pooled, 512), nn.ReLU(), nn.Linear(512, DESCRIPTOR_LENGTH))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = self.column(self.image(self.stem(x) + self.row_bias))
        return functional.normalize(self.head(self._pool(self.ring(y))), dim=1, eps=1e-6)

    def _pool(self, y: torch.Tensor) -> torch.Tensor:
        wide = functional.relu(self.expand(y)).flatten(2)
        level = self.level_norm(torch.cat((wide.mean(2), wide.amax(2)), dim=1))
        cosine, sine = (self.to_waves(y).flatten(2) @ self.waves).chunk(2, dim=2)
        amplitude = torch.sqrt(cosine * cosine + sine * sine + 1e-4).flatten(1)
        return torch.cat((level, self.wave_norm(amplitude)), dim=1)


def _wrap(x: torch.Tensor, margin: int) -> torch.Tensor:
    return torch.cat((x[..., -margin:], x, x[..., :margin]), dim=-1)


def _fourier_basis(n_waves: int) -> torch.Tensor:
    """(N_COLUMNS, 2 * n_waves): cosines then sines of 1..n_waves turns around the ring, unit-gain."""
    turns = np.outer(np.arange(N_COLUMNS), np.arange(1, n_waves + 1)) * (2 * np.pi / N_COLUMNS)
    return torch.from_numpy(np.concatenate((np.cos(turns), np.sin(turns)), axis=1) * (2 / N_COLUMNS)).float()
