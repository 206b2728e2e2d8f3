"""The ground: slopes, waves, roughness, and the road with its kerbs."""

import numpy as np
from scipy.ndimage import distance_transform_edt

from .mesh import Material, Mesh, quads
from .routes import Route

KERB_WIDTH_M = 0.15
CELL_M = 0.25  # of the raster that says which point of the road is nearest


class Terrain:
    """Height and surface of the ground as functions of the place, world frame, metres."""

    def __init__(self, rng: np.random.Generator, route: Route, margin_m: float):
        low, high = route.xy.min(0) - margin_m, route.xy.max(0) + margin_m
        self.bounds = np.array([low, high])  # (2, 2): (x, y) of two corners
        # A street that cars drive along, or a footpath.
        self.road_half_m = rng.uniform(3.3, 4.0) if rng.random() < 0.65 else rng.uniform(2.0, 2.4)
        self.kerb_m = float(rng.choice([0.0, 0.12, 0.14]))
        self._route, self._nearest = route, _nearest_of(route.xy, self.bounds)
        waves = 9
        length = np.concatenate([rng.uniform(45, 120, 4), rng.uniform(12, 30, 5)])
        steep = np.concatenate([rng.uniform(0.005, 0.03, 4), rng.uniform(0.003, 0.010, 5)])
        heading = rng.uniform(0, 2 * np.pi, waves)
        self._wave = (2 * np.pi / length)[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
        self._height = steep * length / (2 * np.pi)
        self._phase = rng.uniform(0, 2 * np.pi, waves)
        self._tilt = rng.normal(0, 0.012, 2)
        self._bumps = rng.normal(0, 1.0, (512, 512))

    def to_road(self, xy) -> np.ndarray:
        """xy: (..., 2) -> (...) metres from the road's centre line (to 2 cm or better beside the road)."""
        xy = np.asarray(xy, float)
        cell = np.clip(((xy - self.bounds[0]) / CELL_M).astype(int), 0, np.array(self._nearest.shape) - 1)
        gap = xy - self._route.xy[self._nearest[cell[..., 0], cell[..., 1]]]
        return np.hypot(gap[..., 0], gap[..., 1])

    def slope_height(self, xy) -> np.ndarray:
        """xy: (..., 2) -> (...) height of the smooth ground (slopes and waves only), metres."""
        xy = np.asarray(xy, float)
        return np.sin(xy @ self._wave.T + self._phase) @ self._height + xy @ self._tilt

    def height(self, xy) -> np.ndarray:
        """xy: (..., 2) -> (...) height of the ground with road, kerb and roughness, metres."""
        xy = np.asarray(xy, float)
        off = self.to_road(xy) - self.road_half_m
        raised = self.kerb_m * np.clip(off / KERB_WIDTH_M, 0, 1)
        rough = 0.004 + 0.022 * np.clip(off / 2.0, 0, 1)
        return self.slope_height(xy) + raised + rough * self._bump(xy)

    def mesh(self, cell_m: float) -> Mesh:
        """The ground as a grid of cell_m, asphalt on the road, soil beside it."""
        (x0, y0), (x1, y1) = self.bounds
        xs, ys = np.arange(x0, x1 + cell_m, cell_m), np.arange(y0, y1 + cell_m, cell_m)
        xy = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1)
        vertices = np.concatenate([xy, self.height(xy)[..., None]], -1).reshape(-1, 3).astype(np.float32)
        index = np.arange(len(vertices), dtype=np.int32).reshape(xy.shape[:2])
        a, b, c, d = (
            index[:-1, :-1].ravel(),
            index[1:, :-1].ravel(),
            index[1:, 1:].ravel(),
            index[:-1, 1:].ravel(),
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        on_road = self.to_road(vertices[faces[:, 0], :2]) < self.road_half_m
        return Mesh(vertices, faces, np.where(on_road, Material.ASPHALT, Material.SOIL).astype(np.uint8))

    def kerbs(self) -> Mesh | None:
        """The kerb stones along both edges of the road, or None where there are none."""
        if not self.kerb_m:
            return None
        strips = [self._kerb(side) for side in (-1, 1)]
        return quads(np.concatenate(strips), Material.CONCRETE)

    def _kerb(self, side: int) -> np.ndarray:
        """(K, 4, 3): face and top of one kerb."""
        s = np.arange(0.0, self._route.length_m, 0.5)
        xy, yaw = self._route.at(s)
        normal = side * np.stack([-np.sin(yaw), np.cos(yaw)], 1)
        face, back = xy + self.road_half_m * normal, xy + (self.road_half_m + KERB_WIDTH_M) * normal
        foot = self.slope_height(face)
        rails = [(face, foot - 0.1), (face, foot + self.kerb_m), (back, foot + self.kerb_m + 0.005)]
        rails = [np.concatenate([at, z[:, None]], 1) for at, z in rails]
        keep = (self.to_road(face) > self.road_half_m - 0.1)[:-1]
        pieces = [
            np.stack([lo[:-1], lo[1:], hi[1:], hi[:-1]], 1)[keep] for lo, hi in zip(rails[:-1], rails[1:], strict=True)
        ]
        return np.concatenate(pieces)

    def _bump(self, xy: np.ndarray) -> np.ndarray:
        """Value noise on a 0.6 m lattice that repeats after 300 m; about unit variance."""
        grid = xy / 0.6
        whole = np.floor(grid).astype(int)
        part = grid - whole
        i, j = np.moveaxis(whole % 512, -1, 0)
        u, v = np.moveaxis(part * part * (3 - 2 * part), -1, 0)
        b = self._bumps
        low = b[i, j] * (1 - u) + b[(i + 1) % 512, j] * u
        high = b[i, (j + 1) % 512] * (1 - u) + b[(i + 1) % 512, (j + 1) % 512] * u
        return low * (1 - v) + high * v


def _nearest_of(line: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """line: (N, 2) metres -> (X, Y) int32 over the bounds: index of the line's point nearest to each cell."""
    shape = np.ceil((bounds[1] - bounds[0]) / CELL_M).astype(int)
    on_line = np.full(shape, -1, np.int32)
    i, j = ((line - bounds[0]) / CELL_M).astype(int).T
    on_line[i, j] = np.arange(len(line))
    nearest = distance_transform_edt(on_line < 0, return_distances=False, return_indices=True)
    return on_line[tuple(nearest)]
