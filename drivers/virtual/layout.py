"""Furnishing a world: houses, trees, parked cars, fences and the rest, around a route."""

import numpy as np

from . import shapes
from .buildings import Building, building
from .mesh import Mesh, merge
from .routes import Route
from .site import Site, disc, rectangle
from .terrain import Terrain
from .vehicles import car

NEAR_M = 28.0  # trees within this of the route have all their leaves


class Layout:
    """Puts things on free ground. `placed` collects (kind, mesh in the world frame)."""

    def __init__(self, rng: np.random.Generator, route: Route, terrain: Terrain):
        self.rng, self.route, self.terrain = rng, route, terrain
        self.site = Site(terrain.bounds)
        self.edge_m = terrain.road_half_m + 0.35  # nothing stands closer to the route's line
        self.placed: list[tuple[str, Mesh]] = []

    def put(self, kind: str, mesh: Mesh, xy, yaw: float, sink: float = 0.02) -> Mesh:
        """Stand a mesh on the ground at xy, turned by yaw; returns it in the world frame."""
        z = float(self.terrain.height(np.asarray(xy))) - sink
        mesh = mesh.moved((*xy, z), yaw)
        self.placed.append((kind, mesh))
        return mesh

    def fits(self, points: np.ndarray, clear_m: float | None = None, also_view: bool = True) -> bool:
        """Whether the points are free and clear_m (else the road) away from the route's line."""
        far = self.terrain.to_road(points).min() > (self.edge_m if clear_m is None else clear_m)
        return bool(far) and self.site.is_free(points, also_view)

    def beside(self, near_m: float, far_m: float) -> tuple[np.ndarray, float, float]:
        """A random place near_m .. far_m beyond the road -> xy, the route's heading there, side (-1, 1)."""
        s, side = self.rng.uniform(0, self.route.length_m), self.rng.choice([-1.0, 1.0])
        lateral = self.edge_m + self.rng.uniform(near_m, far_m)
        return self.route.beside(s, side * lateral), float(self.route.at(s)[1]), side

    def anywhere(self) -> np.ndarray:
        """A random place in the world: (2,)."""
        low, high = self.terrain.bounds
        return self.rng.uniform(low + 2, high - 2)

    def many(self, count: float, one) -> None:
        """Call one() count times (at random rounded up or down)."""
        for _ in range(int(count + self.rng.random())):
            one()


def houses(lay: Layout) -> list[tuple[Building, np.ndarray, float]]:
    """Houses whose doors face the route, and others far off -> [(building, xyz, yaw)] of the near ones."""
    near = []

    def facing(smallest=5.0, largest=15.0, reach=(1.0, 12.0)):
        rng = lay.rng
        length, depth = rng.uniform(smallest, largest), rng.uniform(smallest, 0.75 * largest)
        xy, heading, side = lay.beside(reach[0] + depth / 2, reach[1] + depth / 2)
        yaw = heading + (0 if side > 0 else np.pi) + rng.normal(0, 0.06)  # the front is at local -y
        if not lay.fits(rectangle(xy, yaw, length, depth, margin=0.9)):
            return
        lay.site.take(rectangle(xy, yaw, length, depth, margin=0.7))
        house = building(rng, length, depth, rng.choice([rng.uniform(3.0, 4.2), rng.uniform(5.9, 8.5)]))
        front = np.array([np.sin(yaw), -np.cos(yaw)]) * (depth / 2 + 0.3)
        z = float(lay.terrain.height(xy + front)) + 0.05
        near.append((house, np.array([*xy, z]), yaw))

    def far_off():
        xy, yaw = lay.anywhere(), lay.rng.uniform(0, np.pi)
        length, depth = lay.rng.uniform(8, 22, 2)
        if lay.terrain.to_road(xy) > 25 and lay.fits(rectangle(xy, yaw, length, depth, margin=2.0)):
            lay.site.take(rectangle(xy, yaw, length, depth, margin=1.0))
            house = building(lay.rng, length, depth, lay.rng.uniform(4, 10))
            lay.placed.append(("house", house.shut.moved((*xy, float(lay.terrain.height(xy))), yaw)))

    stretch = lay.route.length_m / 100
    lay.many(14 * stretch + 3, facing)
    lay.many(10 * stretch + 3, lambda: facing(3.0, 6.0, (0.8, 6.0)))
    low, high = lay.terrain.bounds
    lay.many(np.prod(high - low) / 700, far_off)
    return near


def furnish(lay: Layout) -> None:
    """Everything that stands about and never changes."""
    stretch = lay.route.length_m / 100
    lay.many(16 * stretch + 2, lambda: _parked_car(lay))
    lay.many(9 * stretch, lambda: _fence(lay))
    lay.many(7 * stretch, lambda: _long(lay, "hedge", shapes.hedge, 0.8, (2.0, 7.0)))
    lay.many(5 * stretch, lambda: _long(lay, "wall", shapes.wall, 0.4, (2.5, 8.0)))
    lay.many(
        0.8 * stretch,
        lambda: _long(lay, "container", lambda rng, _: shapes.container(rng), 2.5, (6.06, 6.07)),
    )
    for shape, count, reach in (
        (shapes.lamp, 5, (0.1, 1.0)),
        (shapes.pole, 5, (0.0, 6.0)),
        (shapes.bench, 3, (0.5, 5.0)),
        (shapes.bin_, 4, (0.1, 6.0)),
        (shapes.bollard, 5, (0.0, 1.5)),
        (shapes.crate, 3, (0.5, 8.0)),
        (shapes.rock, 5, (0.5, 15.0)),
        (shapes.cone, 2, (0.0, 3.0)),
        (shapes.person, 1.5, (0.5, 9.0)),
    ):
        lay.many(count * stretch + 0.5, lambda shape=shape, reach=reach: _small(lay, shape, reach))
    lay.many(30 * stretch + 6, lambda: _tree(lay, lay.beside(0.8, 22.0)[0]))
    low, high = lay.terrain.bounds
    lay.many(np.prod(high - low) / 160, lambda: _tree(lay, lay.anywhere()))
    lay.many(40 * stretch + 4, lambda: _bush(lay))
    lay.many(7 * stretch + 1, lambda: _puddle(lay))
    _meadow(lay, int(600 * stretch) + 60)


def _small(lay: Layout, shape, reach) -> None:
    mesh = shape(lay.rng)
    xy, heading, side = lay.beside(*reach)
    spot = disc(xy, max(0.25, mesh.radius if mesh.radius < 1.0 else 0.4))
    if lay.fits(spot):
        lay.site.take(spot)
        facing = heading + (np.pi if side > 0 else 0.0) + lay.rng.normal(0, 0.3)
        lay.put(shape.__name__.strip("_"), mesh, xy, facing)


def _parked_car(lay: Layout) -> None:
    xy, heading, _ = lay.beside(1.1, 1.6) if lay.rng.random() < 0.7 else lay.beside(2.0, 14.0)
    yaw = heading + lay.rng.choice([0.0, np.pi]) + lay.rng.normal(0, 0.05)
    spot = rectangle(xy, yaw, 5.0, 2.0, margin=0.3)
    if lay.fits(spot):
        lay.site.take(spot)
        lay.placed.append(("car", standing_car(lay, car(lay.rng).shut, xy, yaw)))


def standing_car(lay: Layout, mesh: Mesh, xy, yaw: float) -> Mesh:
    """A car's part set on the ground with the tilt of the slope below it, world frame."""
    ahead = 1.3 * np.array([np.cos(yaw), np.sin(yaw)])
    across = 0.8 * np.array([-np.sin(yaw), np.cos(yaw)])
    front, rear, left, right = (float(lay.terrain.height(xy + d)) for d in (ahead, -ahead, across, -across))
    z = (front + rear + left + right) / 4
    return mesh.moved((*xy, z), yaw, pitch=-np.arctan2(front - rear, 2.6), roll=np.arctan2(left - right, 1.6))


def _fence(lay: Layout) -> None:
    xy, heading, _ = lay.beside(0.6, 12.0)
    count, yaw = (
        int(lay.rng.integers(3, 9)),
        heading + lay.rng.choice([0.0, 0.0, np.pi / 2]) + lay.rng.normal(0, 0.04),
    )
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    posts = xy + 2.0 * np.arange(count)[:, None] * ahead
    spot = rectangle((posts[0] + posts[-1]) / 2, yaw, 2.0 * (count - 1), 0.2)
    if lay.fits(spot):
        lay.site.take(spot)
        lay.placed.append(("fence", shapes.fence(lay.rng, lay.terrain.height(posts)).moved((*xy, 0.0), yaw)))


def _long(lay: Layout, kind: str, shape, width: float, lengths) -> None:
    length = lay.rng.uniform(*lengths)
    xy, heading, _ = lay.beside(0.5 + width / 2, 14.0)
    yaw = heading + lay.rng.choice([0.0, np.pi / 2]) + lay.rng.normal(0, 0.05)
    spot = rectangle(xy, yaw, length, width)
    if lay.fits(spot):
        lay.site.take(spot)
        lay.put(kind, shape(lay.rng, length), xy, yaw, sink=0.08)


def _tree(lay: Layout, xy) -> None:
    if not lay.fits(disc(xy, 0.8)):
        return
    lay.site.take(disc(xy, 0.4))
    near = lay.terrain.to_road(xy) < NEAR_M
    shape = shapes.conifer if lay.rng.random() < 0.3 else shapes.tree
    lay.put("tree", shape(lay.rng, int(lay.rng.uniform(1200, 2400)) if near else 420), xy, lay.rng.uniform(0, 6))


def _bush(lay: Layout) -> None:
    xy = lay.beside(0.6, 18.0)[0]
    if lay.fits(disc(xy, 0.8)):
        lay.site.take(disc(xy, 0.5))
        lay.put("bush", shapes.bush(lay.rng), xy, 0.0)


def _puddle(lay: Layout) -> None:
    """Water on the road or beside it; it takes no room."""
    xy = lay.beside(-lay.edge_m, 3.0)[0]
    if lay.site.is_free(disc(xy, 0.6), also_view=False):
        mesh = shapes.puddle(lay.rng, lambda rim: lay.terrain.height(rim + xy))
        lay.placed.append(("puddle", mesh.moved((*xy, 0.0))))


def _meadow(lay: Layout, count: int) -> None:
    """Tufts of grass in patches: one thing, not hundreds."""
    tufts = []
    for _ in range(count // 12 + 1):
        middle = lay.beside(0.5, 14.0)[0]
        for xy in middle + lay.rng.normal(0, 1.6, (12, 2)):
            if lay.fits(xy[None]):
                tufts.append(shapes.grass(lay.rng).moved((*xy, float(lay.terrain.height(xy)))))
    if tufts:
        lay.placed.append(("grass", merge(tufts)))
