"""Convex hulls in the plane, grown by a margin so that a straight path has an area."""

from __future__ import annotations

import numpy as np


def convex_hull(points: np.ndarray) -> np.ndarray:
    """Vertices (M, 2) of the convex hull of points (N, 2), counter-clockwise.

    One point or a straight line give one or two vertices, where Qhull would refuse (Andrew's monotone chain).
    """
    unique = np.unique(np.asarray(points, dtype=np.float64).reshape(-1, 2), axis=0)
    if len(unique) <= 2:
        return unique
    lower, upper = _chain(unique), _chain(unique[::-1])
    return np.array(lower[:-1] + upper[:-1])


def _chain(points: np.ndarray) -> list[np.ndarray]:
    chain: list[np.ndarray] = []
    for point in points:
        while len(chain) >= 2 and _cross(chain[-1] - chain[-2], point - chain[-2]) <= 1e-12:
            chain.pop()
        chain.append(point)
    return chain


def _cross(a: np.ndarray, b: np.ndarray) -> float:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def grown_area_m2(vertices: np.ndarray, margin_m: float) -> float:
    """Area of the hull grown by the margin (Minkowski sum with a disc)."""
    edges = np.roll(vertices, -1, axis=0) - vertices
    perimeter = np.linalg.norm(edges, axis=1).sum()
    area = 0.5 * abs(_cross(vertices, np.roll(vertices, -1, axis=0)).sum())
    return float(area + perimeter * margin_m + np.pi * margin_m**2)


def distance_m(vertices: np.ndarray, point: np.ndarray) -> float:
    """Distance of a point (2,) to the hull; 0 inside."""
    start, edge = vertices, np.roll(vertices, -1, axis=0) - vertices
    to_point = point - start
    if len(vertices) >= 3 and (_cross(edge, to_point) >= 0).all():
        return 0.0
    length2 = np.maximum((edge**2).sum(axis=1), 1e-12)
    along = np.clip((to_point * edge).sum(axis=1) / length2, 0.0, 1.0)
    return float(np.linalg.norm(to_point - along[:, None] * edge, axis=1).min())
