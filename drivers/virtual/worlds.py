"""Seeded outdoor worlds: a route, what stands around it, what changes, what moves."""

from dataclasses import dataclass, replace

import numpy as np

from .layout import Layout, furnish, houses
from .mesh import Mesh
from .patrols import Pass, Patrol
from .routes import Route, line, loop
from .scenarios import SCENARIOS, Scenario
from .staging import Mover, movers, stage
from .terrain import Terrain

NOTHING = 0  # object id of a pixel without a return


@dataclass(frozen=True, eq=False)
class Item:
    """One thing of the world; its object id is its index + 1."""

    kind: str
    mesh: Mesh  # world frame
    first_pass: int = 0
    last_pass: int | None = None  # None: to the end

    def is_there(self, pass_index: int) -> bool:
        return self.first_pass <= pass_index and (self.last_pass is None or pass_index <= self.last_pass)


@dataclass(frozen=True)
class Change:
    """An item that appeared at, or was gone from, the start of a pass on."""

    kind: str
    polarity: str  # "appeared" | "disappeared"
    pass_index: int  # the first pass that shows it
    object_id: int
    part_of: int | None = None  # index of the change it belongs to: the place that an opened door has left


@dataclass(frozen=True, eq=False)
class World:
    """Everything of one seed. World frame: metres, z up. Movers' object ids follow the items'."""

    seed: int
    scenario: Scenario
    route: Route
    terrain: Terrain
    patrol: Patrol
    items: tuple[Item, ...]
    movers: tuple[Mover, ...]
    changes: tuple[Change, ...]

    @property
    def kinds(self) -> list[str]:
        """Kind of each object id; id 0 is no return, the last one the robot itself."""
        return [
            "nothing",
            *(item.kind for item in self.items),
            *(mover.kind for mover in self.movers),
            "vehicle",
        ]


def build_world(scenario: Scenario, seed: int) -> World:
    """The world of a scenario and a seed; the same arguments give the same world."""
    # Streams of their own for route, ground and so on: a change to one leaves the others as they were.
    streams = [np.random.default_rng([seed, len(scenario.name), ord(scenario.name[0]), k]) for k in range(6)]
    length = streams[0].uniform(*scenario.length_m)
    route = (loop if scenario.closed else line)(streams[0], length)
    terrain = Terrain(streams[1], route, scenario.margin_m)
    patrol = Patrol(route, terrain, _passes(scenario, terrain, streams[2]), streams[2])
    lay = Layout(streams[3], route, terrain)
    near = houses(lay)
    stages, spare = stage(lay, near, scenario, scenario.passes)
    lay.placed += [("house", house.shut.moved(xyz, yaw)) for house, xyz, yaw in spare]
    furnish(lay)
    ground = terrain.mesh(0.5 if length < 200 else 0.7)
    kerbs = terrain.kerbs()
    items = [Item("ground", ground)] + ([Item("kerb", kerbs)] if kerbs else [])
    items += [Item(kind, mesh) for kind, mesh in lay.placed]
    changes = []
    for one in stages:
        changes += _changes(one, len(items), len(changes), scenario.passes)
        items += [Item(*state) for state in one.states]
    lay.rng = streams[4]
    return World(
        seed,
        scenario,
        route,
        terrain,
        patrol,
        tuple(items),
        tuple(movers(lay, scenario, patrol)),
        tuple(changes),
    )


def random_world(seed: int, scenario: str = "short", length_m: float | None = None) -> World:
    """A world for training or trying out, after a named scenario, with another route length if given."""
    plan = SCENARIOS[scenario]
    return build_world(replace(plan, length_m=(length_m, length_m)) if length_m else plan, seed)


def _passes(scenario: Scenario, terrain: Terrain, rng) -> list[Pass]:
    """Other offset and speed on each pass; to the right where cars drive in the left lane."""
    spread = np.array([0.1, -0.85, -0.45, -1.2]) if terrain.road_half_m > 3.0 else np.array([0.0, 0.55, -0.5, 0.3])
    offsets = rng.permutation(spread)
    return [
        Pass(
            float(offsets[k % 4] + rng.normal(0, 0.08)),
            float(rng.uniform(*scenario.speed_m_s)),
            scenario.reversed_pass == k,
        )
        for k in range(scenario.passes)
    ]


def _changes(one, first_index: int, first_change: int, n_passes: int) -> list[Change]:
    """Each coming and going of a stage's states; those of the shut door belong to those of the open one."""
    found = []
    for k, (kind, _, first, last) in enumerate(one.states):
        events = [("appeared", first)] if first > 0 else []
        events += [("disappeared", last + 1)] if last is not None and last + 1 < n_passes else []
        for polarity, at in events:
            owner = next((first_change + i for i, c in enumerate(found) if c.pass_index == at), None) if k else None
            found.append(Change(kind, polarity, at, first_index + k + 1, owner))
    return found
