"""Houses with recessed windows and doors, pilasters, roofs, and a room behind the door."""

from dataclasses import dataclass

import numpy as np

from .mesh import Material, Mesh, box, merge, quads, triangles, tube

SUNK_M = 1.6  # walls go this far below the floor, so that no slope shows a gap
DOOR_SIZE_M = (1.0, 2.1)
DOOR_OPEN_RAD = np.deg2rad(80)


@dataclass(frozen=True, eq=False)
class Building:
    """A house about the origin, its front (with the door) towards -y; its floor is at z = 0."""

    body: Mesh
    door_shut: Mesh
    door_open: Mesh
    door_xyz: np.ndarray  # (3,) metres, the middle of the shut door
    size: tuple[float, float]  # length along x, depth along y, metres

    @property
    def shut(self) -> Mesh:
        return merge([self.body, self.door_shut])


@dataclass(frozen=True)
class Opening:
    """A hole in a facade: along the wall, height of its sill, size; metres."""

    x: float
    z: float
    width: float
    height: float
    is_door: bool = False


def building(rng: np.random.Generator, length: float, depth: float, height: float) -> Building:
    """A house of length x depth, walls `height` metres high."""
    skin = Material.BRICK if rng.random() < 0.6 else Material.CONCRETE
    recess = rng.uniform(0.12, 0.25)
    parts, doors = [], None
    for side, (yaw, wide, far) in enumerate(
        (
            (0, length, depth),
            (0.5 * np.pi, depth, length),
            (np.pi, length, depth),
            (1.5 * np.pi, depth, length),
        )
    ):
        holes = _openings(rng, wide, height, with_door=side == 0)
        wall = _facade(holes, wide, height, skin, recess) + _trim(rng, wide, height, skin)
        place = dict(xyz=rotated((0, -far / 2), yaw), yaw=yaw)
        parts += [part.moved(**place) for part in wall]
        if side == 0:
            doors = [panel.moved(**place) for panel in _door(next(hole for hole in holes if hole.is_door), recess)]
            hole = next(hole for hole in holes if hole.is_door)
            parts.append(_room(hole, recess).moved(**place))
            door_xyz = np.array([hole.x, -far / 2 + recess, DOOR_SIZE_M[1] / 2])
    parts += _roof(rng, length, depth, height)
    return Building(merge(parts), doors[0], doors[1], door_xyz, (length, depth))


def rotated(xy, yaw: float) -> tuple[float, float, float]:
    """(x, y) turned by yaw -> (x, y, 0)."""
    return (xy[0] * np.cos(yaw) - xy[1] * np.sin(yaw), xy[0] * np.sin(yaw) + xy[1] * np.cos(yaw), 0.0)


def _openings(rng, wide: float, height: float, with_door: bool) -> list[Opening]:
    """Windows in a grid of bays, one of them a door if asked."""
    bays = max(1, int(wide / rng.uniform(2.4, 3.6)))
    pitch, holes = wide / bays, []
    door_bay = int(rng.integers(bays)) if with_door else -1
    for floor in range(max(1, int(height / 2.9))):
        for bay in range(bays):
            x = -wide / 2 + (bay + 0.5) * pitch
            if floor == 0 and bay == door_bay:
                holes.append(Opening(x, 0.02, *DOOR_SIZE_M, is_door=True))
            elif rng.random() < 0.75:
                holes.append(
                    Opening(x, 2.9 * floor + 0.95, min(rng.uniform(0.9, 1.5), pitch - 0.8), rng.uniform(1.0, 1.4))
                )
    return [hole for hole in holes if hole.z + hole.height < height - 0.15]


def _facade(holes: list[Opening], wide: float, height: float, skin: Material, recess: float) -> list[Mesh]:
    """The wall in the plane y = 0, seen from -y, cut along the holes' edges; reveals and panes behind it."""
    xs = np.unique([-wide / 2, wide / 2, *(h.x + s * h.width / 2 for h in holes for s in (-1, 1))])
    zs = np.unique([-SUNK_M, height, *(z for h in holes for z in (h.z, h.z + h.height))])
    x_mid, z_mid = np.meshgrid((xs[:-1] + xs[1:]) / 2, (zs[:-1] + zs[1:]) / 2, indexing="ij")
    solid = np.ones(x_mid.shape, bool)
    for h in holes:
        solid &= ~((np.abs(x_mid - h.x) < h.width / 2) & (z_mid > h.z) & (z_mid < h.z + h.height))
    i, j = np.nonzero(solid)
    cell = np.stack([_at(xs[i + a], 0, zs[j + b]) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], 1)
    parts = [quads(cell, skin)]
    for h in holes:
        rim = np.array([[h.x + a * h.width / 2, 0, h.z + b * h.height] for a, b in ((-1, 0), (1, 0), (1, 1), (-1, 1))])
        back = rim + [0, recess, 0]
        parts.append(quads(np.stack([rim, np.roll(rim, -1, 0), np.roll(back, -1, 0), back], 1), skin))
        if not h.is_door:
            parts.append(quads(back[None], Material.GLASS))
            parts.append(quads(back[None] + [0, 0.35, 0], Material.CLOTH))  # curtain: what a ray finds past the pane
            bar = box((0.06, 0.05, h.height), Material.WOOD, (h.x, recess - 0.03, h.z))
            parts.append(bar)
    return parts


def _at(x, y, z) -> np.ndarray:
    return np.stack([x, np.full_like(x, y), z], -1)


def _trim(rng, wide: float, height: float, skin: Material) -> list[Mesh]:
    """What stands out of a wall: pilasters, a plinth, a downpipe, a meter box or air conditioner."""
    parts = [box((wide + 0.1, 0.1, SUNK_M + 0.3), Material.CONCRETE, (0, -0.02, -SUNK_M - 0.28))]
    if rng.random() < 0.5:
        parts += [box((0.35, 0.24, height + SUNK_M), skin, (s * (wide / 2 - 0.3), -0.06, -SUNK_M)) for s in (-1, 1)]
    pipe = rng.uniform(-0.48, 0.48) * wide
    parts.append(tube([[pipe, -0.08, -0.5], [pipe, -0.08, height]], [0.05, 0.05], Material.METAL, 6))
    if rng.random() < 0.6:
        parts.append(
            box((0.7, 0.35, 0.6), Material.METAL, (rng.uniform(-0.4, 0.4) * wide, -0.2, rng.uniform(0.1, 2.2)))
        )
    return parts


def _door(hole: Opening, recess: float) -> list[Mesh]:
    """[shut, open]: a leaf with a handle, turning outwards on its left edge."""
    leaf = box((hole.width - 0.03, 0.05, hole.height - 0.03), Material.WOOD, (hole.x, recess - 0.03, hole.z + 0.01))
    handle = box((0.12, 0.1, 0.04), Material.METAL, (hole.x + hole.width / 2 - 0.15, recess - 0.06, hole.z + 1.0))
    shut = merge([leaf, handle])
    hinge = np.array([hole.x - hole.width / 2 + 0.015, 0.02, 0.0])
    front = shut.moved((0, 0.02 - recess, 0))  # the open leaf stands in front of the wall, not in its reveal
    return [shut, front.moved(-hinge).moved(hinge, yaw=-DOOR_OPEN_RAD)]


def _room(hole: Opening, recess: float) -> Mesh:
    """The hall behind the door: floor, side walls, back wall, ceiling, a cupboard."""
    x, w, d, h = hole.x, 1.3, 3.2, 2.5
    y = recess + 0.02
    left, right = x - w, x + w
    corner = np.array(
        [
            [[left, y, 0], [right, y, 0], [right, y + d, 0], [left, y + d, 0]],
            [[left, y, h], [right, y, h], [right, y + d, h], [left, y + d, h]],
            [[left, y + d, 0], [right, y + d, 0], [right, y + d, h], [left, y + d, h]],
            [[left, y, 0], [left, y + d, 0], [left, y + d, h], [left, y, h]],
            [[right, y, 0], [right, y + d, 0], [right, y + d, h], [right, y, h]],
        ]
    )
    return merge([quads(corner, Material.CONCRETE), box((0.8, 0.5, 1.7), Material.WOOD, (x + 0.7, y + d - 0.4, 0))])


def _roof(rng, length: float, depth: float, height: float) -> list[Mesh]:
    """A gabled roof with eaves, or a flat one with a parapet."""
    if rng.random() < 0.65:
        x, y, top = length / 2 + 0.35, depth / 2 + 0.45, height + rng.uniform(0.25, 0.45) * depth
        slopes = [[[-x, s * y, height - 0.1], [x, s * y, height - 0.1], [x, 0, top], [-x, 0, top]] for s in (-1, 1)]
        gables = [
            [
                [s * length / 2, -depth / 2, height],
                [s * length / 2, depth / 2, height],
                [s * length / 2, 0, top - 0.1],
            ]
            for s in (-1, 1)
        ]
        chimney = box((0.6, 0.6, 1.6), Material.BRICK, (rng.uniform(-0.3, 0.3) * length, 0.5, top - 0.8))
        return [quads(slopes, Material.BRICK), triangles(gables, Material.BRICK), chimney]
    edge = [box((length + 0.2, 0.2, 0.5), Material.CONCRETE, (0, s * depth / 2, height)) for s in (-1, 1)]
    edge += [box((0.2, depth, 0.5), Material.CONCRETE, (s * length / 2, 0, height)) for s in (-1, 1)]
    return [*edge, box((length, depth, 0.1), Material.CONCRETE, (0, 0, height - 0.1))]
