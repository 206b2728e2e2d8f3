"""Cars, lofted from sections across their length, with doors that open."""

from dataclasses import dataclass

import numpy as np

from .mesh import Material, Mesh, box, loft, merge, quads, tube

# Stations along the car, front to rear: x (share of its length); floor, belt, roof (heights of a 1.5 m high
# car); belt half width, roof half width (shares of the half width). Where roof = belt there is no cabin.
SEDAN = (
    (0.00, 0.35, 0.62, 0.62, 0.80, 0.74),
    (0.03, 0.22, 0.70, 0.70, 0.93, 0.88),
    (0.22, 0.20, 0.88, 0.88, 1.00, 0.92),
    (0.28, 0.20, 0.93, 0.97, 1.00, 0.84),
    (0.40, 0.20, 0.95, 1.41, 1.00, 0.72),
    (0.62, 0.20, 0.96, 1.48, 1.00, 0.72),
    (0.74, 0.20, 0.98, 1.40, 1.00, 0.72),
    (0.86, 0.22, 1.00, 1.04, 0.98, 0.84),
    (0.97, 0.26, 0.98, 0.98, 0.92, 0.86),
    (1.00, 0.38, 0.80, 0.80, 0.84, 0.80),
)
WAGON = SEDAN[:6] + (
    (0.78, 0.20, 0.98, 1.48, 1.00, 0.74),
    (0.93, 0.22, 1.00, 1.40, 0.98, 0.74),
    (0.99, 0.28, 0.98, 1.02, 0.94, 0.80),
    (1.00, 0.40, 0.82, 0.82, 0.90, 0.80),
)
VAN = (
    (0.00, 0.32, 0.75, 0.75, 0.88, 0.84),
    (0.03, 0.24, 0.95, 0.95, 0.95, 0.90),
    (0.13, 0.24, 1.05, 1.10, 1.00, 0.92),
    (0.26, 0.24, 1.05, 1.72, 1.00, 0.86),
    (0.40, 0.24, 1.06, 1.82, 1.00, 0.88),
    (0.62, 0.24, 1.06, 1.84, 1.00, 0.88),
    (0.80, 0.24, 1.06, 1.84, 1.00, 0.88),
    (0.98, 0.26, 1.05, 1.78, 0.98, 0.86),
    (1.00, 0.36, 1.00, 1.30, 0.96, 0.90),
)
DOOR = 0.40  # the front doors lie between this station and the next
DOOR_OPEN_RAD = np.deg2rad(62)


@dataclass(frozen=True, eq=False)
class Car:
    """A car about the origin, facing +x, in parts."""

    body: Mesh  # everything but the left front door
    door_shut: Mesh
    door_open: Mesh

    @property
    def shut(self) -> Mesh:
        """The whole car, doors shut."""
        return merge([self.body, self.door_shut])


def car(rng: np.random.Generator, model: str | None = None) -> Car:
    """A sedan, wagon or van (at random unless named) of usual size."""
    model = model or str(rng.choice(["sedan", "wagon", "van"], p=[0.45, 0.35, 0.2]))
    table = np.array({"sedan": SEDAN, "wagon": WAGON, "van": VAN}[model])
    length, half = (rng.uniform(4.1, 4.8), rng.uniform(0.86, 0.93)) if model != "van" else (rng.uniform(4.8, 5.4), 0.97)
    table[:, 1:4] *= rng.uniform(0.95, 1.08)
    x = (0.5 - table[:, 0]) * length
    floor, belt, roof = table[:, 1], table[:, 2], table[:, 3]
    wide, narrow = table[:, 4] * half, table[:, 5] * half
    # Half outline of each section: floor middle, sill, bulge, belt, roof edge, roof middle.
    bulge = np.stack([x, wide, 0.6 * floor + 0.4 * belt], 1)
    left = np.stack(
        [
            np.stack([x, 0 * x, floor], 1),
            np.stack([x, wide * 0.94, floor], 1),
            bulge,
            np.stack([x, wide * 0.97, belt], 1),
            np.stack([x, narrow, roof], 1),
            np.stack([x, 0 * x, roof + 0.02], 1),
        ],
        1,
    )
    first = int(np.argmin(np.abs(table[:, 0] - DOOR)))
    door = np.array([_strip(left, k, first) for k in (1, 2, 3)])
    skin = _skin(left, first, keep_door=False) + _skin(left * [1, -1, 1], first, keep_door=True)
    body = merge(skin + _ends(left) + _wheels(length, half) + _inside(x[first], half, floor[first]))
    shut = _door_panel(door)
    hinge = door[0, 0] * [1, 1, 0]
    opened = shut.moved(-hinge).moved(hinge, yaw=-DOOR_OPEN_RAD)
    return Car(body, shut, opened)


def _strip(left: np.ndarray, row: int, station: int) -> np.ndarray:
    """(4, 3): the quad of the half outline between two stations and outline points row, row + 1."""
    return np.array([left[station, row], left[station + 1, row], left[station + 1, row + 1], left[station, row + 1]])


def _skin(left: np.ndarray, door_station: int, keep_door: bool) -> list[Mesh]:
    parts = []
    for row in range(left.shape[1] - 1):
        for station in range(len(left) - 1):
            if station == door_station and row in (1, 2, 3) and not keep_door:
                continue
            quad = _strip(left, row, station)
            cabin = quad[:, 2].max() - left[station : station + 2, 3, 2].max() > 0.12
            slanted = abs(left[station, 4, 2] - left[station + 1, 4, 2]) > 0.25
            glass = (row == 3 and cabin) or (row == 4 and slanted)
            parts.append(quads(quad[None], Material.GLASS if glass else Material.PAINT))
    return parts


def _ends(left: np.ndarray) -> list[Mesh]:
    ends = []
    for section in (left[0], left[-1]):
        mirror = section[::-1] * [1, -1, 1]
        ends.append(loft(np.stack([section, mirror[::-1]]), Material.PAINT, closed=False))
    return ends


def _wheels(length: float, half: float) -> list[Mesh]:
    wheels = []
    for x in (0.31 * length, -0.29 * length):
        for y in (half - 0.24, -half - 0.02):
            wheels.append(tube([[x, y, 0.32], [x, y + 0.26, 0.32]], [0.32, 0.32], Material.RUBBER, 14))
    return wheels


def _inside(x_front: float, half: float, floor: float) -> list[Mesh]:
    parts = [box((0.12, 2 * half - 0.3, 0.45), Material.PLASTIC, (x_front + 0.25, 0, floor + 0.25))]
    for y in (-0.4, 0.4):
        parts.append(box((0.5, 0.5, 0.3), Material.CLOTH, (x_front - 0.55, y, floor + 0.1)))
        parts.append(box((0.14, 0.5, 0.7), Material.CLOTH, (x_front - 0.85, y, floor + 0.25)))
    return parts


def _door_panel(strips: np.ndarray) -> Mesh:
    """strips: (3, 4, 3): sill to bulge, bulge to belt, window -> a door with an outer and an inner face."""
    inner = strips * [1, 1, 1] - [0, 0.07, 0]
    metal = [quads(side[:2], Material.PAINT) for side in (strips, inner)]
    edges = [
        quads(np.stack([strips[:2, a], strips[:2, b], inner[:2, b], inner[:2, a]], 1), Material.PAINT)
        for a, b in ((0, 3), (1, 2))
    ]
    return merge([*metal, *edges, quads(strips[2:], Material.GLASS)])
