"""Passes over (N, 3) arrays, which numpy makes slowly along their short axis."""

from __future__ import annotations

import numpy as np

from .jit import kernel


@kernel
def bounds(points):
    """Lower and upper corner (3,) of the box around points (N, 3), N > 0; their dtype."""
    lower, upper = points[0].copy(), points[0].copy()
    for i in range(len(points)):
        for axis in range(3):
            lower[axis] = min(lower[axis], points[i, axis])
            upper[axis] = max(upper[axis], points[i, axis])
    return lower, upper


@kernel
def inside(points, lower, upper):
    """Which points (N, 3) lie within a box: (N,) bool."""
    out = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        out[i] = lower[0] < x and x < upper[0] and lower[1] < y and y < upper[1] and lower[2] < z and z < upper[2]
    return out


@kernel
def keep(points, scan, kept):
    """The points (N, 3) and scans (N,) at which kept (N,) bool holds."""
    n = 0
    for i in range(len(kept)):
        n += kept[i]
    out, out_scan = np.empty((n, 3), points.dtype), np.empty(n, scan.dtype)
    n = 0
    for i in range(len(kept)):
        if kept[i]:
            for axis in range(3):
                out[n, axis] = points[i, axis]
            out_scan[n] = scan[i]
            n += 1
    return out, out_scan
