"""What happens in a world: things that come, go or open between passes, and people and cars that move."""

from dataclasses import dataclass

import numpy as np

from . import shapes
from .layout import Layout, standing_car
from .mesh import Mesh
from .patrols import Patrol
from .routes import Route
from .scenarios import Scenario, Staged
from .site import disc, rectangle, strip
from .vehicles import car

# kind: (shape, radius of its place in metres, distance from the route's line in metres)
THINGS = {
    "backpack": (shapes.backpack, 0.4, (2.3, 7.5)),
    "person": (shapes.person, 0.4, (2.6, 11.0)),
    "crate": (shapes.crate, 0.5, (2.4, 9.0)),
    "cone": (shapes.cone, 0.35, (2.3, 7.0)),
    "bin": (shapes.bin_, 0.5, (2.5, 10.0)),
    "bench": (shapes.bench, 1.0, (3.2, 9.0)),
    "pole": (shapes.pole, 0.4, (2.5, 10.0)),
    "fence_panel": (shapes.fence_panel, 1.2, (3.0, 10.0)),
    "fallen_tree": (shapes.fallen_tree, 2.6, (4.9, 12.0)),
}
KINDS = (*THINGS, "car", "car_door", "house_door")
GAIT = np.sin(2 * np.pi * np.arange(8) / 8)  # how far the left leg is ahead, over one stride
STRIDE_M = 1.4
ROBOT_CLEAR_M = 2.2


@dataclass(frozen=True, eq=False)
class Stage:
    """A staged thing as placed: (kind, mesh, first pass, last pass or None) for each of its states."""

    states: tuple[tuple[str, Mesh, int, int | None], ...]
    main: int = 0  # index of the state that the staging is about


@dataclass(frozen=True, eq=False)
class Mover:
    """Someone walking up and down, or a car going round, during one pass."""

    kind: str
    meshes: tuple[Mesh, ...]  # over one stride; a car has one
    path: Route
    pass_index: int
    speed_m_s: float
    start_m: float

    def along(self, t_s) -> np.ndarray:
        """t_s -> metres walked."""
        return self.start_m + self.speed_m_s * np.asarray(t_s, float)

    def place(self, t_s) -> tuple[np.ndarray, np.ndarray]:
        """t_s: (...) -> xy (..., 2), heading (...)."""
        along = self.along(t_s)
        if self.path.closed:
            return self.path.at(along)
        span = self.path.length_m
        back = np.mod(along, 2 * span) > span
        xy, yaw = self.path.at(np.where(back, 2 * span - np.mod(along, 2 * span), np.mod(along, 2 * span)))
        return xy, np.where(back, yaw + np.pi, yaw)

    def mesh_at(self, t_s: float) -> int:
        """Which of its meshes shows at t_s."""
        return int(self.along(t_s) / STRIDE_M * len(self.meshes)) % len(self.meshes)


def stage(lay: Layout, houses: list, scenario: Scenario, n_passes: int) -> tuple[list[Stage], list]:
    """Places the scenario's changes where the route sees them -> (stages, the houses that no change needs).

    Spreads them along the route, away from its start. Raises ValueError where the world has no room.
    """
    wanted = [s for s in scenario.staged if s.first < n_passes]
    spare = list(houses)
    # House doors first: they need the few houses that suit; then large things.
    order = sorted(
        wanted,
        key=lambda s: -{"house_door": 9.0, "car": 3.0, "car_door": 3.0}.get(s.kind, THINGS.get(s.kind, (0, 0))[1]),
    )
    stages, taken_s = [], []
    for one in order:
        last = one.last if one.last is not None and one.last < n_passes - 1 else None
        one = Staged(one.kind, one.first, last)
        stages.append(_house_door(lay, spare, one) if one.kind == "house_door" else _placed(lay, one, taken_s))
    return stages, spare


def _spot(lay: Layout, taken_s: list, attempt: int) -> float:
    """A place along the route, away from its start and (at first) from the other changes."""
    length = lay.route.length_m
    apart = 0.6 * length / (len(taken_s) + 3) * 0.98**attempt
    keep = min(14.0, 0.15 * length)
    for _ in range(50):
        s = lay.rng.uniform(keep, length - keep)
        if all(abs(s - other) > apart for other in taken_s):
            break
    return float(s)


def _placed(lay: Layout, one: Staged, taken_s: list) -> Stage:
    for attempt in range(400):
        s, side = _spot(lay, taken_s, attempt), lay.rng.choice([-1.0, 1.0])
        build = _try_car if one.kind in ("car", "car_door") else _try_thing
        made = build(lay, one, s, side)
        if made:
            taken_s.append(s)
            return made
    raise ValueError(f"no room for a {one.kind} beside the route")


def _view(lay: Layout, s: float, xy) -> np.ndarray:
    """The ground between xy and the route, 4 m to both sides: (K, 2)."""
    return np.concatenate([strip(xy, lay.route.at(s + d)[0]) for d in (-4.0, -2.0, 0.0, 2.0, 4.0)])


def _claim(lay: Layout, spot: np.ndarray, s: float, xy, clear_m: float) -> bool:
    view = _view(lay, s, xy)
    own = disc(xy, 0.1 + np.linalg.norm(spot - xy, axis=1).max())
    if not lay.fits(spot, clear_m) or not lay.site.is_free(view, also_view=False):
        return False
    lay.site.keep_open(view)
    lay.site.take(spot)
    lay.site.keep_open(own)
    return True


def _try_thing(lay: Layout, one: Staged, s: float, side: float) -> Stage | None:
    shape, radius, reach = THINGS[one.kind]
    lateral = lay.rng.uniform(*reach)
    xy, heading = lay.route.beside(s, side * lateral), float(lay.route.at(s)[1])
    if not _claim(lay, disc(xy, radius), s, xy, max(ROBOT_CLEAR_M, radius + 1.6)):
        return None
    turned = heading + (np.pi if side > 0 else 0.0) + lay.rng.normal(0, 0.4)
    mesh = lay.put(one.kind, shape(lay.rng), xy, turned)
    lay.placed.pop()
    return Stage(((one.kind, mesh, one.first, one.last),))


def _try_car(lay: Layout, one: Staged, s: float, side: float) -> Stage | None:
    lateral = lay.edge_m + lay.rng.uniform(1.2, 5.0)
    xy, heading = lay.route.beside(s, side * lateral), float(lay.route.at(s)[1])
    yaw = heading if side < 0 else heading + np.pi  # its left door towards the route
    if not _claim(lay, rectangle(xy, yaw, 5.2, 2.0, margin=0.3), s, xy, lay.edge_m):
        return None
    made = car(lay.rng)
    if one.kind == "car":
        return Stage((("car", standing_car(lay, made.shut, xy, yaw), one.first, one.last),))
    parts = [standing_car(lay, part, xy, yaw) for part in (made.door_open, made.door_shut)]
    lay.placed.append(("car", standing_car(lay, made.body, xy, yaw)))
    return _door(one, *parts)


def _house_door(lay: Layout, spare: list, one: Staged) -> Stage:
    for index in lay.rng.permutation(len(spare)):
        house, xyz, yaw = spare[index]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        door = turn @ house.door_xyz[:2] + xyz[:2]
        step_out = door + turn @ np.array([0.0, -1.3])
        gap = np.linalg.norm(lay.route.xy - door, axis=1)
        s = float(np.argmin(gap) * lay.route.length_m / len(lay.route.xy))
        view = _view(lay, s, step_out)
        if 2.5 < gap.min() < 15.0 and lay.site.is_free(view, also_view=False):
            lay.site.keep_open(view)
            lay.site.keep_open(disc(step_out, 0.8))
            del spare[index]
            parts = [part.moved(xyz, yaw) for part in (house.door_open, house.door_shut)]
            lay.placed.append(("house", house.body.moved(xyz, yaw)))
            return _door(one, *parts)
    raise ValueError("no house whose door the route sees")


def _door(one: Staged, opened: Mesh, shut: Mesh) -> Stage:
    """Open from the first to the last pass, shut before and after."""
    states = [(one.kind, opened, one.first, one.last)]
    if one.first > 0:
        states.append((one.kind, shut, 0, one.first - 1))
    if one.last is not None:
        states.append((one.kind, shut, one.last + 1, None))
    return Stage(tuple(states))


def movers(lay: Layout, scenario: Scenario, patrol: Patrol) -> list[Mover]:
    """People walking (some close to the route) and cars driving along, new ones for each pass."""
    stretch, made = lay.route.length_m / 100, []
    wide = lay.terrain.road_half_m > 3.0
    for index in range(len(patrol.passes)):
        for _ in range(max(2, round(scenario.people_per_100_m * stretch))):
            walker = _walker(lay, patrol, index)
            made += [walker] if walker else []
        if wide and lay.route.closed:
            for _ in range(max(1, round(scenario.cars_per_100_m * stretch))):
                made.append(_driver(lay, index))
    return made


def _walker(lay: Layout, patrol: Patrol, pass_index: int) -> Mover | None:
    rng = lay.rng
    meshes = None
    for _ in range(60):
        path = _walk_along(lay) if rng.random() < 0.6 else _walk_across(lay)
        if path is None or not lay.site.is_free(
            np.concatenate([path.xy + d for d in ((0.3, 0), (-0.3, 0), (0, 0.3), (0, -0.3))]), also_view=False
        ):
            continue
        if meshes is None:
            body = int(rng.integers(1 << 30))
            meshes = tuple(shapes.person(np.random.default_rng(body), stride) for stride in GAIT)
        walker = Mover("walker", meshes, path, pass_index, rng.uniform(0.8, 1.7), rng.uniform(0, 2 * path.length_m))
        if _keeps_away(walker, patrol):
            return walker
    return None


def _walk_along(lay: Layout) -> Route | None:
    rng = lay.rng
    length = rng.uniform(15, 45)
    if not lay.route.closed:
        length = min(length, 0.9 * lay.route.length_m)
    start = rng.uniform(0, lay.route.length_m if lay.route.closed else lay.route.length_m - length)
    s = start + np.arange(0, length, 0.2)
    lateral = rng.choice([-1, 1]) * rng.uniform(1.9, lay.edge_m + 1.5)
    return Route(lay.route.beside(s, lateral + 0.3 * np.sin(s / rng.uniform(3, 8))), closed=False)


def _walk_across(lay: Layout) -> Route | None:
    rng = lay.rng
    middle = lay.route.beside(rng.uniform(0, lay.route.length_m), rng.uniform(-12, 12))
    yaw, half = rng.uniform(0, 2 * np.pi), rng.uniform(5, 14)
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    return Route(middle + np.linspace(-half, half, int(10 * half))[:, None] * ahead, closed=False)


def _keeps_away(walker: Mover, patrol: Patrol) -> bool:
    """Whether it never comes within 1.1 m of the robot during its pass."""
    ends = [*patrol.pass_start_s, patrol.duration_s + 0.2]
    t = np.arange(ends[walker.pass_index] - 0.2, ends[walker.pass_index + 1] + 0.2, 0.1)
    gap = walker.place(t)[0] - patrol.pose(t)[:, :2, 3]
    return bool(np.linalg.norm(gap, axis=1).min() > 1.1)


def _driver(lay: Layout, pass_index: int) -> Mover:
    """A car in the left lane, which the robot's passes leave free."""
    s = np.arange(0, lay.route.length_m, 0.25)
    lane = Route(lay.route.beside(s, 2.5), closed=True)
    rng = lay.rng
    return Mover("driver", (car(rng).shut,), lane, pass_index, rng.uniform(3.0, 6.0), rng.uniform(0, lane.length_m))
