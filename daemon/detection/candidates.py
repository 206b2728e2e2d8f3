"""Candidate changes by distance to nearest neighbours, and the noise filter (CDSD III-C). Both exact."""

from __future__ import annotations

import numpy as np

from .arrays import bounds
from .jit import kernel

AXIS_BITS = 21  # of a cell's key for each axis: two million cells a side
FIRST_SLOTS = 1 << 16  # a submap of 50 m fills 30 thousand cells of 0.3 m
OWN_CELL = 13  # of the 27 around a point, counted along z, y, x


def changed(points: np.ndarray, reference: np.ndarray, tau_m: float, n: int) -> np.ndarray:
    """Which points (N, 3) float32 lie on average farther than tau from their n nearest of the reference (M, 3)."""
    return _far_from_nearest(points, reference, tau_m, n, 0)


def dense_enough(points: np.ndarray, rho_m: float, n: int) -> np.ndarray:
    """Noise filter: which candidates (N, 3) float32 lie on average within rho of their n nearest fellow candidates."""
    return ~_far_from_nearest(points, points, rho_m, n + 1, 1)


def _far_from_nearest(points: np.ndarray, reference: np.ndarray, radius_m: float, n: int, n_self: int) -> np.ndarray:
    """Whether the n nearest reference points of each point, of which n_self are itself, are farther than radius on
    average.

    Exact, and hardly ever a search: n reference points within the radius settle it, and the reference lies in cells of
    that side, so the point's own cell mostly has them. None within the radius settles it too. Only between the two
    are the distances summed, shell of cells by shell, until what is not looked at yet cannot change the answer.
    """
    out = np.ones(len(points), dtype=bool)
    if len(points) == 0 or len(reference) < n:
        return out
    # The farthest shell looked at is the n-th: no cell index is ever negative.
    origin = np.minimum(bounds(points)[0], bounds(reference)[0]).astype(np.float64) - (n + 1) * radius_m
    n_slots, table = FIRST_SLOTS, None
    while table is None:
        table = _cell_table(reference, origin, 1.0 / radius_m, n_slots)
        n_slots *= 4
    _search(points, origin, radius_m, n, n_self, *table, out)
    return out


@kernel
def _key(x, y, z):
    return (np.int64(x) << (2 * AXIS_BITS)) | (np.int64(y) << AXIS_BITS) | np.int64(z)


@kernel
def _slot(key, slot_key):
    """The slot that holds a key, or the free one where it belongs (open addressing, linear probing)."""
    mask = slot_key.size - 1
    at = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(24)
    slot = np.int64(at) & mask
    while slot_key[slot] != key and slot_key[slot] != -1:
        slot = (slot + 1) & mask
    return slot


@kernel
def _cell_table(points, origin, per_m, n_slots):
    """A hash table of cells: each slot's key, first point and end in `ordered`, the points by slot.

    None where the cells fill more than half of the slots.
    """
    slot_key = np.full(n_slots, -1, np.int64)
    first = np.zeros(n_slots + 1, np.int32)
    slot_of = np.empty(len(points), np.int32)
    n_cells = 0
    for i in range(len(points)):
        key = _key(
            (points[i, 0] - origin[0]) * per_m, (points[i, 1] - origin[1]) * per_m, (points[i, 2] - origin[2]) * per_m
        )
        slot = _slot(key, slot_key)
        if slot_key[slot] == -1:
            slot_key[slot] = key
            n_cells += 1
            if 2 * n_cells > n_slots:
                return None
        slot_of[i] = slot
        first[slot + 1] += 1
    for slot in range(n_slots):
        first[slot + 1] += first[slot]
    ordered = np.empty_like(points)
    used = np.zeros(n_slots, np.int32)
    for i in range(len(points)):
        slot = slot_of[i]
        ordered[first[slot] + used[slot]] = points[i]
        used[slot] += 1
    return slot_key, first, ordered


@kernel
def _search(points, origin, radius, n, n_self, slot_key, first, ordered, out):
    per_m = 1.0 / radius
    nearest = np.empty(n, np.float64)
    for i in range(len(points)):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        cx = np.int64((x - origin[0]) * per_m)
        cy = np.int64((y - origin[1]) * per_m)
        cz = np.int64((z - origin[2]) * per_m)
        found = _count_within(x, y, z, cx, cy, cz, radius, n, slot_key, first, ordered)
        if found >= n:
            out[i] = False
        elif found > n_self:
            out[i] = _sum_exceeds(x, y, z, cx, cy, cz, radius, n, n_self, slot_key, first, ordered, nearest)


@kernel
def _count_within(x, y, z, cx, cy, cz, radius, n, slot_key, first, ordered):
    """Reference points within the radius, counted up to n; the point's own cell first."""
    found = 0
    squared = radius * radius
    for step in range(27):
        k = (step + OWN_CELL) % 27
        slot = _slot(_key(cx + k // 9 - 1, cy + k // 3 % 3 - 1, cz + k % 3 - 1), slot_key)
        for j in range(first[slot], first[slot + 1]):
            dx, dy, dz = ordered[j, 0] - x, ordered[j, 1] - y, ordered[j, 2] - z
            if dx * dx + dy * dy + dz * dz <= squared:
                found += 1
                if found >= n:
                    return found
    return found


@kernel
def _sum_exceeds(x, y, z, cx, cy, cz, radius, n, n_self, slot_key, first, ordered, nearest):
    """Whether the n smallest distances sum to more than radius * (n - n_self)."""
    limit = radius * (n - n_self)
    nearest[:] = np.inf
    for shell in range(1, n + 1):
        for ix in range(-shell, shell + 1):
            for iy in range(-shell, shell + 1):
                on_side = abs(ix) == shell or abs(iy) == shell or shell == 1
                step = 1 if on_side else 2 * shell
                for iz in range(-shell, shell + 1, step):
                    slot = _slot(_key(cx + ix, cy + iy, cz + iz), slot_key)
                    for j in range(first[slot], first[slot + 1]):
                        dx, dy, dz = ordered[j, 0] - x, ordered[j, 1] - y, ordered[j, 2] - z
                        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                        k = n - 1
                        if distance < nearest[k]:
                            while k > 0 and nearest[k - 1] > distance:
                                nearest[k] = nearest[k - 1]
                                k -= 1
                            nearest[k] = distance
        reach = shell * radius  # all within it has been seen
        total, left = 0.0, n
        for k in range(n):
            if nearest[k] <= reach:
                total += nearest[k]
                left -= 1
        if left == 0:
            return total > limit
        if total + left * reach >= limit:
            return True
    return True
