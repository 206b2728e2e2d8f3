"""Things found outdoors, as meshes standing on the origin; each differs a little every time."""

import numpy as np

from .mesh import Material, Mesh, box, ellipsoid, leaves, merge, quads, triangles, tube

Rng = np.random.Generator


def person(rng: Rng, stride: float = 0.0) -> Mesh:
    """Someone standing; facing +x. stride: -1 .. 1, how far the left leg is ahead (walking)."""
    height = rng.uniform(1.58, 1.92)
    k, girth = height / 1.75, rng.uniform(0.85, 1.2)
    swing = 0.32 * stride
    parts = [ellipsoid((0.095, 0.08, 0.125), Material.CLOTH, (0.02, 0, 1.62))]
    parts.append(
        tube([[0, 0, 0.88], [0, 0, 1.15], [0, 0, 1.42], [0, 0, 1.54]], [0.15, 0.14, 0.17, 0.06], Material.CLOTH)
    )
    for side in (-1, 1):
        foot = side * swing
        knee = [0.5 * foot + 0.03, side * 0.1, 0.48]
        parts.append(
            tube(
                [[0, side * 0.09, 0.92], knee, [foot, side * 0.11, 0.08]],
                [0.085, 0.065, 0.05],
                Material.CLOTH,
            )
        )
        parts.append(box((0.27, 0.1, 0.08), Material.RUBBER, (foot + 0.06, side * 0.11, 0)))
        hand = [-0.9 * foot + 0.08, side * 0.27, 0.84]
        parts.append(
            tube(
                [[0, side * 0.2, 1.42], [-0.4 * foot, side * 0.26, 1.12], hand],
                [0.055, 0.045, 0.035],
                Material.CLOTH,
            )
        )
    return merge(parts).moved(scale=(k * girth, k * girth, k))


def backpack(rng: Rng) -> Mesh:
    """A backpack standing on the ground, 40 to 52 cm high."""
    h = rng.uniform(0.40, 0.52)
    body = ellipsoid((0.17, 0.14, h * 0.52), Material.CLOTH, (0, 0, h * 0.5), sides=14)
    pocket = ellipsoid((0.12, 0.07, h * 0.25), Material.CLOTH, (0, 0.13, h * 0.28))
    return merge([body, pocket, tube([[0, -0.05, h], [0, 0, h + 0.05], [0, 0.05, h]], [0.015] * 3, Material.CLOTH, 5)])


def cone(rng: Rng) -> Mesh:
    """A traffic cone, 50 to 75 cm high."""
    h = rng.uniform(0.5, 0.75)
    shaft = tube([[0, 0, 0.04], [0, 0, h]], [0.15, 0.03], Material.PLASTIC, 12)
    return merge([box((0.38, 0.38, 0.04), Material.PLASTIC), shaft])


def crate(rng: Rng) -> Mesh:
    """A cardboard box or crate, 35 to 70 cm."""
    x, y, z = rng.uniform(0.35, 0.7, 3)
    return merge([box((x, y, z), Material.WOOD), box((x + 0.03, y + 0.03, 0.04), Material.WOOD, (0, 0, z))])


def bin_(rng: Rng) -> Mesh:
    """A wheelie bin or a round litter bin, about 1 m high."""
    if rng.random() < 0.5:
        body = box((0.48, 0.52, 0.9), Material.PLASTIC, (0, 0, 0.08), taper=1.18)
        lid = box((0.62, 0.62, 0.07), Material.PLASTIC, (0, 0, 0.98))
        wheels = [tube([[-0.2, y, 0.1], [-0.2, y + 0.06, 0.1]], [0.1, 0.1], Material.RUBBER) for y in (-0.3, 0.24)]
        return merge([body, lid, *wheels])
    h = rng.uniform(0.75, 1.0)
    return tube([[0, 0, 0], [0, 0, h], [0, 0, h + 0.06]], [0.24, 0.3, 0.2], Material.METAL, 14)


def bench(rng: Rng) -> Mesh:
    """A park bench, its back to -y."""
    length = rng.uniform(1.4, 1.9)
    seat = [box((length, 0.1, 0.035), Material.WOOD, (0, y, 0.44)) for y in (-0.14, 0.0, 0.14)]
    back = [box((length, 0.03, 0.1), Material.WOOD, (0, -0.24 - 0.05 * k, 0.58 + 0.16 * k)) for k in (0, 1)]
    legs = [box((0.06, 0.42, 0.44), Material.METAL, (x * length * 0.42, 0, 0)) for x in (-1, 1)]
    posts = [
        tube([[x * length * 0.42, -0.2, 0.4], [x * length * 0.42, -0.31, 0.86]], [0.03] * 2, Material.METAL)
        for x in (-1, 1)
    ]
    return merge(seat + back + legs + posts)


def pole(rng: Rng) -> Mesh:
    """A thin post with a sign, 2.2 to 3 m high."""
    h = rng.uniform(2.2, 3.0)
    post = tube([[0, 0, 0], [0, 0, h]], [0.045, 0.045], Material.METAL)
    return merge([post, box((0.02, rng.uniform(0.4, 0.7), rng.uniform(0.4, 0.7)), Material.METAL, (0.06, 0, h - 0.75))])


def lamp(rng: Rng) -> Mesh:
    """A street lamp, 4 to 6.5 m high."""
    h = rng.uniform(4.0, 6.5)
    arm = tube([[0, 0, h - 0.1], [0.5, 0, h + 0.1], [1.1, 0, h + 0.1]], [0.05, 0.04, 0.04], Material.METAL, 6)
    foot = tube([[0, 0, 0], [0, 0, 0.9], [0, 0, h]], [0.13, 0.1, 0.06], Material.METAL)
    return merge([foot, arm, box((0.6, 0.24, 0.12), Material.METAL, (1.2, 0, h))])


def bollard(rng: Rng) -> Mesh:
    """A short thick post, 0.7 to 1 m high."""
    h = rng.uniform(0.7, 1.0)
    return tube([[0, 0, 0], [0, 0, h], [0, 0, h + 0.05]], [0.09, 0.08, 0.04], Material.CONCRETE, 10)


def fence_panel(rng: Rng, length: float = 2.2) -> Mesh:
    """One free-standing panel of a construction fence along x: frame, bars, feet; 1.2 to 1.8 m high."""
    h = rng.uniform(1.2, 1.8)
    bars = np.arange(-length / 2 + 0.1, length / 2 - 0.05, 0.1)
    parts = [tube([[x, 0, 0.15], [x, 0, h]], [0.012] * 2, Material.METAL, 4) for x in bars]
    parts += [tube([[x, 0, 0], [x, 0, h]], [0.03] * 2, Material.METAL, 6) for x in (-length / 2, length / 2)]
    parts += [tube([[-length / 2, 0, z], [length / 2, 0, z]], [0.025] * 2, Material.METAL, 6) for z in (0.15, h)]
    parts += [box((0.25, 0.7, 0.12), Material.CONCRETE, (x, 0, 0)) for x in (-length / 2, length / 2)]
    return merge(parts)


def fence(rng: Rng, heights: np.ndarray, step: float = 2.0) -> Mesh:
    """A picket or board fence along +x; heights: (K,) ground height at each post, `step` metres apart."""
    solid, h = rng.random() < 0.4, rng.uniform(0.9, 1.6)
    posts = [
        tube([[k * step, 0, z - 0.3], [k * step, 0, z + h]], [0.05] * 2, Material.WOOD, 6)
        for k, z in enumerate(heights)
    ]
    parts, width = posts, 1.0 if solid else rng.uniform(0.45, 0.6)
    for k, (z0, z1) in enumerate(zip(heights[:-1], heights[1:], strict=True)):
        x = k * step + step * np.arange(0.0, 0.999, 0.075)
        z, w = z0 + (z1 - z0) * (x - k * step) / step, 0.075 * step * width
        corner = np.stack(
            [np.stack([x + a * w, 0 * x + 0.04, z + b], -1) for a, b in ((0, 0.05), (1, 0.05), (1, h), (0, h))],
            1,
        )
        parts.append(quads(corner, Material.WOOD))
    return merge(parts)


def wall(rng: Rng, length: float) -> Mesh:
    """A low garden wall along x with a coping."""
    h = rng.uniform(0.5, 1.3)
    return merge(
        [
            box((length, 0.3, h + 0.5), Material.BRICK, (0, 0, -0.5)),
            box((length, 0.4, 0.08), Material.CONCRETE, (0, 0, h)),
        ]
    )


def container(rng: Rng) -> Mesh:
    """A shipping container with its corrugation, 6.06 m long."""
    x = np.linspace(-3.03, 3.03, 81)
    depth = 1.22 - 0.035 * ((np.arange(81) // 2) % 2)
    sides = [np.stack([[a, s * d, z] for a, d in zip(x, depth, strict=True)]) for s in (-1, 1) for z in (0.1, 2.55)]
    walls = [
        quads(np.stack([lo[:-1], lo[1:], hi[1:], hi[:-1]], 1), Material.PAINT) for lo, hi in (sides[:2], sides[2:])
    ]
    return merge(
        [
            *walls,
            box((6.06, 2.44, 0.1), Material.METAL),
            box((6.06, 2.44, 0.05), Material.PAINT, (0, 0, 2.55)),
            *(box((0.06, 2.44, 2.5), Material.PAINT, (s * 3.0, 0, 0.08)) for s in (-1, 1)),
        ]
    )


def rock(rng: Rng) -> Mesh:
    """A boulder, half sunk."""
    body = ellipsoid(rng.uniform(0.25, 0.7, 3), Material.CONCRETE, sides=9)
    return merge([body]).moved(yaw=rng.uniform(0, 6), scale=rng.uniform(0.8, 1.2, 3))


def tree(rng: Rng, n_leaves: int = 1500, tall: float = 1.0) -> Mesh:
    """A broad-leaved tree: bent trunk, boughs, leaf clouds that rays pass through."""
    h = rng.uniform(4.5, 9.0) * tall
    bend = rng.normal(0, 0.12, 2) * h / 6
    trunk = np.array([[0, 0, -0.3], [0, 0, 0.35], [*bend * 0.4, h * 0.3], [*bend, h * 0.62], [*bend * 1.2, h * 0.85]])
    r = rng.uniform(0.1, 0.22) * h / 6.5
    parts, tips = [tube(trunk, [r * 1.5, r, r * 0.85, r * 0.5, r * 0.15], Material.WOOD, 9)], [trunk[-1]]
    for angle in rng.uniform(0, 2 * np.pi) + np.arange(rng.integers(5, 8)) * 2.4:
        start = trunk[2] + (trunk[3] - trunk[2]) * rng.uniform(0, 1)
        out = h * rng.uniform(0.16, 0.32)
        tip = start + [out * np.cos(angle), out * np.sin(angle), h * rng.uniform(0.1, 0.25)]
        parts.append(
            tube(
                [start, 0.5 * (start + tip) - [0, 0, 0.05 * out], tip],
                [r * 0.4, r * 0.3, r * 0.12],
                Material.WOOD,
                6,
            )
        )
        tips.append(tip)
    tips = np.array(tips)
    pick = rng.integers(0, len(tips), n_leaves)
    ball = rng.normal(0, 1, (n_leaves, 3))
    ball *= rng.random((n_leaves, 1)) ** 0.4 / np.linalg.norm(ball, axis=1, keepdims=True)
    parts.append(leaves(tips[pick] + ball * h * [0.18, 0.18, 0.14], 0.12 * (1500 / n_leaves) ** 0.4, rng))
    return merge(parts)


def conifer(rng: Rng, n_leaves: int = 1500, tall: float = 1.0) -> Mesh:
    """A spruce: straight trunk, whorls of drooping twigs."""
    h = rng.uniform(4.0, 10.0) * tall
    level = rng.random(n_leaves) ** 0.7
    reach = 0.28 * h * (1 - level) * rng.random(n_leaves) ** 0.35 + 0.08
    angle = rng.uniform(0, 2 * np.pi, n_leaves)
    z = h * (0.12 + 0.88 * level) - 0.25 * reach
    centres = np.stack([reach * np.cos(angle), reach * np.sin(angle), z], 1)
    r = 0.018 * h
    trunk = tube([[0, 0, -0.3], [0, 0, 0.3], [0, 0, h]], [r * 1.4, r, 0.02], Material.WOOD)
    return merge([trunk, leaves(centres, 0.11 * (1500 / n_leaves) ** 0.4, rng)])


def bush(rng: Rng, n_leaves: int = 420) -> Mesh:
    """A shrub of 0.5 to 1.6 m."""
    half = rng.uniform(0.45, 0.9, 3) * [1, 1, 0.9]
    ball = rng.normal(0, 1, (n_leaves, 3))
    ball *= rng.random((n_leaves, 1)) ** 0.35 / np.linalg.norm(ball, axis=1, keepdims=True)
    stems = [tube([[0, 0, -0.1], [*rng.normal(0, 0.25, 2), half[2]]], [0.02, 0.01], Material.WOOD, 4) for _ in range(4)]
    return merge([leaves(ball * half + [0, 0, half[2] * 0.95], 0.07, rng), *stems])


def hedge(rng: Rng, length: float) -> Mesh:
    """A clipped hedge along x, 0.8 to 1.6 m high."""
    h, n = rng.uniform(0.8, 1.6), int(220 * length)
    spots = rng.uniform(-0.5, 0.5, (n, 3))
    face = rng.integers(0, 3, n)
    spots[face == 0, 1] = 0.5 * np.sign(spots[face == 0, 1]) * rng.uniform(0.8, 1, (face == 0).sum())
    spots[face == 1, 2] = rng.uniform(0.4, 0.5, (face == 1).sum())
    return leaves(spots * [length, 0.6, h] + [0, 0, h / 2], 0.09, rng)


def grass(rng: Rng, blades: int = 16) -> Mesh:
    """A tuft of tall grass, 15 to 50 cm."""
    foot = np.concatenate([rng.normal(0, 0.1, (blades, 2)), np.full((blades, 1), -0.03)], 1)
    tip = foot + np.concatenate([rng.normal(0, 0.1, (blades, 2)), rng.uniform(0.15, 0.5, (blades, 1))], 1)
    side = np.concatenate([rng.normal(0, 0.012, (blades, 2)), np.zeros((blades, 1))], 1)
    corner = np.stack([foot - side, foot + side, tip], 1)
    return triangles(corner, Material.LEAF)


def fallen_tree(rng: Rng) -> Mesh:
    """A young tree lying on the ground along x, 3.5 to 5.5 m long."""
    length = rng.uniform(3.5, 5.5)
    upright = tree(rng, 400, tall=0.75)
    k = length / upright.vertices[:, 2].max()
    lying = upright.moved(pitch=np.pi / 2, scale=k).vertices
    lying[:, 0] -= length / 2
    lying[:, 2] = lying[:, 2] * 0.45 + 0.3
    lying[:, 2] = np.maximum(lying[:, 2], 0.02)
    return Mesh(lying, upright.faces, upright.material)


def puddle(rng: Rng, height) -> Mesh:
    """Standing water, 0.6 to 2 m across. height: function of xy (K, 2) -> ground height, about the origin."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    r = rng.uniform(0.3, 1.0) * (1 + 0.2 * np.sin(2 * angle + rng.uniform(0, 6)) + 0.1 * np.sin(5 * angle))
    rim = np.stack([r * np.cos(angle), r * np.sin(angle)], 1)
    rim = np.concatenate([rim, height(rim)[:, None] + 0.012], 1)
    middle = np.broadcast_to(rim.mean(0), rim.shape)
    return triangles(np.stack([middle, rim, np.roll(rim, -1, 0)], 1), Material.WATER)


def vehicle() -> Mesh:
    """What a sensor on a mast sees of the robot below and behind: deck, box, two antennas. Sensor frame."""
    deck = box((1.2, 0.7, 0.05), Material.METAL, (-0.35, 0, -0.42))
    case = box((0.25, 0.36, 0.24), Material.PLASTIC, (-0.8, 0, -0.37))
    whips = [tube([[-0.65, y, -0.4], [-0.65, y, 0.3]], [0.012, 0.008], Material.PLASTIC, 6) for y in (-0.32, 0.32)]
    return merge([deck, case, *whips])
