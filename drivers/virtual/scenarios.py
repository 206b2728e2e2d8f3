"""The patrols that can be simulated."""

from dataclasses import dataclass

ALWAYS = None


@dataclass(frozen=True)
class Staged:
    """A thing that is there (or a door that is open) only from one pass until another.

    kind: one of staging.KINDS. first: the first pass with it; last: the last one, None if it stays.
    """

    kind: str
    first: int = 0
    last: int | None = ALWAYS


@dataclass(frozen=True)
class Scenario:
    """What a patrol is like; the world around it, the exact route and all positions vary with the seed."""

    name: str
    about: str
    length_m: tuple[float, float]  # of the route
    passes: int
    staged: tuple[Staged, ...]
    closed: bool = True  # a loop; otherwise a line driven there and back
    reversed_pass: int | None = None  # the pass that is driven against the first one's direction
    speed_m_s: tuple[float, float] = (1.4, 2.1)
    people_per_100_m: float = 5.0  # walking about, on each pass
    cars_per_100_m: float = 1.0  # driving along, on each pass
    margin_m: float = 50.0  # of furnished world around the route


SCENARIOS = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            "tiny",
            "for tests: there and back again, two changes",
            (9.0, 10.0),
            2,
            (Staged("person", 1), Staged("crate", 0, 0)),
            closed=False,
            reversed_pass=1,
            speed_m_s=(2.0, 2.2),
            people_per_100_m=12,
            margin_m=30.0,
        ),
        Scenario(
            "demo",
            "twice around a small block, four changes",
            (58.0, 66.0),
            2,
            (Staged("person", 1), Staged("backpack", 0, 0), Staged("car_door", 1), Staged("bin", 1)),
            speed_m_s=(1.9, 2.3),
            margin_m=40.0,
        ),
        Scenario(
            "short",
            "three laps: a backpack put down and taken away again, a car door opened, a person come",
            (100.0, 150.0),
            3,
            (Staged("backpack", 1, 1), Staged("car_door", 1), Staged("person", 2)),
        ),
        Scenario(
            "long",
            "three laps, the last one the other way round; 18 changes of all kinds",
            (250.0, 350.0),
            3,
            (
                Staged("backpack", 1, 1),
                Staged("car", 1),
                Staged("person", 1),
                Staged("cone", 1),
                Staged("crate", 1),
                Staged("fence_panel", 1),
                Staged("car_door", 1),
                Staged("backpack", 2),
                Staged("pole", 2),
                Staged("fallen_tree", 2),
                Staged("bin", 2),
                Staged("house_door", 2),
                Staged("car", 0, 0),
                Staged("bench", 0, 0),
                Staged("bin", 0, 0),
                Staged("person", 0, 1),
                Staged("pole", 0, 1),
            ),
            reversed_pass=2,
            speed_m_s=(1.8, 2.4),
        ),
        Scenario("quiet", "three laps on which nothing changes; people and cars pass by", (100.0, 150.0), 3, ()),
        Scenario(
            "loop600",
            "two laps of 600 m or more, on which odometry drifts",
            (610.0, 680.0),
            2,
            (
                Staged("car", 1),
                Staged("person", 1),
                Staged("crate", 0, 0),
                Staged("bench", 0, 0),
                Staged("fence_panel", 1),
                Staged("backpack", 1),
            ),
            speed_m_s=(2.0, 2.5),
            people_per_100_m=3.0,
            cars_per_100_m=0.6,
            margin_m=40.0,
        ),
    )
}
