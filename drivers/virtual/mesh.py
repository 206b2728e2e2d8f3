"""Triangle meshes: the parts of which the virtual worlds are made."""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

BOX_FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


class Material(IntEnum):
    """What a face is made of; sensor.py says how each answers the laser."""

    ASPHALT = 0
    SOIL = 1
    CONCRETE = 2
    BRICK = 3
    WOOD = 4
    METAL = 5
    PAINT = 6
    GLASS = 7
    LEAF = 8
    CLOTH = 9
    RUBBER = 10
    WATER = 11
    PLASTIC = 12


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a material each. Metres; x forward, y left, z up."""

    vertices: np.ndarray  # (N, 3) float32
    faces: np.ndarray  # (M, 3) int32
    material: np.ndarray  # (M,) uint8

    def moved(self, xyz=(0.0, 0.0, 0.0), yaw=0.0, pitch=0.0, roll=0.0, scale=1.0) -> "Mesh":
        """Scaled, then turned (radians; roll about x, pitch about y, yaw about z), then shifted by xyz."""
        turned = self.vertices * np.asarray(scale, np.float32) @ rotation(yaw, pitch, roll).T
        return replace(self, vertices=(turned + np.asarray(xyz)).astype(np.float32))

    def of(self, material: Material) -> "Mesh":
        """The same shape in one material."""
        return replace(self, material=np.full(len(self.faces), material, np.uint8))

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the z axis, metres."""
        return float(np.hypot(self.vertices[:, 0], self.vertices[:, 1]).max())


def rotation(yaw, pitch=0.0, roll=0.0) -> np.ndarray:
    """Radians (scalars or equal shapes ...) -> (..., 3, 3) float64, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    yaw, pitch, roll = np.broadcast_arrays(yaw, pitch, roll)
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    out = np.empty((*yaw.shape, 3, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -sp, cp * sr, cp * cr
    return out


def merge(meshes) -> Mesh:
    """Several meshes as one."""
    meshes = list(meshes)
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


def triangles(corners, material: Material) -> Mesh:
    """corners: (M, 3, 3) metres -> M loose triangles."""
    corners = np.asarray(corners, np.float32).reshape(-1, 3)
    faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Mesh(corners, faces, np.full(len(faces), material, np.uint8))


def quads(corners, material: Material) -> Mesh:
    """corners: (K, 4, 3) metres, around each quad -> 2 K triangles."""
    corners = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    first = 4 * np.arange(len(corners), dtype=np.int32)[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]]).astype(np.int32)
    return Mesh(corners.reshape(-1, 3), faces, np.full(len(faces), material, np.uint8))


def box(size, material: Material, base=(0.0, 0.0, 0.0), taper: float = 1.0) -> Mesh:
    """A box of size (x, y, z) standing on base (the centre of its foot); its top is `taper` as wide."""
    x, y, z = size
    corner = np.array([[i, j, k] for k in (0, 1) for j in (-0.5, 0.5) for i in (-0.5, 0.5)])
    corner[4:, :2] *= taper
    vertices = corner * [x, y, z] + base
    return quads(vertices[np.array(BOX_FACES)], material)


def loft(rings, material: Material, closed: bool = True) -> Mesh:
    """rings: (K, P, 3) metres, K outlines of P points -> the surface between; closed joins last to first."""
    rings = np.asarray(rings, np.float32)
    count, points = rings.shape[:2]
    index = np.arange(count * points, dtype=np.int32).reshape(count, points)
    following = np.roll(index, -1, 1)
    span = slice(None) if closed else slice(None, -1)
    a, b, c, d = (part[:, span].ravel() for part in (index[:-1], following[:-1], following[1:], index[1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return Mesh(rings.reshape(-1, 3), faces, np.full(len(faces), material, np.uint8))


def tube(path, radii, material: Material, sides: int = 8) -> Mesh:
    """path: (K, 3) metres, radii: K metres -> a round rod along the path with closed ends."""
    path, radii = np.asarray(path, float), np.asarray(radii, float)
    ahead = np.gradient(path, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    helper = np.where(np.abs(ahead[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(ahead, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, ahead)
    angle = 2 * np.pi * np.arange(sides) / sides
    round_ = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    rings = path[:, None] + radii[:, None, None] * round_
    ends = [np.repeat(path[k][None, None], sides, 1) for k in (0, -1)]
    return loft(np.concatenate([ends[0], rings, ends[1]]), material)


def ellipsoid(radii, material: Material, centre=(0.0, 0.0, 0.0), sides: int = 10) -> Mesh:
    """A closed ellipsoid with half axes `radii` about `centre`, metres."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, max(5, sides // 2 + 1))[:, None]
    longitude = 2 * np.pi * np.arange(sides)[None] / sides
    ball = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude) + 0 * longitude,
        ],
        -1,
    )
    return loft(ball * np.asarray(radii) + np.asarray(centre), material)


def leaves(centres, size_m: float, rng: np.random.Generator) -> Mesh:
    """centres: (K, 3) metres -> K loose leaf triangles of about size_m, turned at random."""
    centres = np.asarray(centres, float)
    shape = rng.normal(0.0, 1.0, (len(centres), 3, 3))
    shape *= size_m / np.sqrt(3) * rng.uniform(0.6, 1.4, (len(centres), 1, 1))
    return triangles(centres[:, None] + shape, Material.LEAF)
