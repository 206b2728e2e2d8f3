"""Small hand-made worlds, which the virtual sensor drives through: genuine packets, scans at true poses, detection.

World frame = map frame: x along the path, y left, z up, metres; the robot drives past the origin. What is true of a
change is what the ray caster met of it, never what the detector says.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache

import numpy as np
from scipy.spatial import cKDTree

from revisitd.daemon.config import Config
from revisitd.daemon.detection.detector import detect, side_of
from revisitd.daemon.detection.results import DetectedObject, Detection, Thresholds
from revisitd.daemon.detection.submap import Submap
from revisitd.daemon.geometry import inverse
from revisitd.daemon.submap_build import build_submap
from revisitd.drivers.frame import Frame, Sensor
from revisitd.drivers.ouster import sensor_from_metadata
from revisitd.drivers.packets import FrameAssembler, frame_from_sdk
from revisitd.drivers.virtual import shapes
from revisitd.drivers.virtual.buildings import Building, building
from revisitd.drivers.virtual.mesh import Material, Mesh, box, merge, rotation
from revisitd.drivers.virtual.packets import Encoder
from revisitd.drivers.virtual.raycast import Caster, Hits
from revisitd.drivers.virtual.routes import Route
from revisitd.drivers.virtual.sensor import receive, virtual_metadata
from revisitd.drivers.virtual.staging import GAIT, Mover
from revisitd.drivers.virtual.vehicles import car
from revisitd.drivers.virtual.worlds import Item
from revisitd.storage.scans import Scan

THRESHOLDS = Thresholds(**Config().detection.model_dump())
RANGE_M = Config().submaps.range_m
SENSOR_HEIGHT_M = 1.5
OS1_64 = virtual_metadata(64, 1024, 10, "RNG15_RFL8_NIR8")
OS1_128 = virtual_metadata(128, 1024, 10, "RNG19_RFL8_SIG16_NIR16")
OS1_32 = virtual_metadata(32, 1024, 10, "RNG19_RFL8_SIG16_NIR16")
VISIT_FRAMES = 10_000  # from the start of one visit to that of the next: a quarter of an hour
NEVER = 10**9  # a pass that no visit reaches
SURFACE_VOXEL_M = 0.10
COVERED_M = 0.15
OWN_M = 0.5  # most of a reported object lies this near to the surface of what it is of


@dataclass(frozen=True, eq=False)
class Thing:
    """Something that stands in the world; mesh in the world frame."""

    kind: str
    mesh: Mesh
    visits: tuple[int, ...] | None = None  # those that have it; None: all, and it is no change
    since: float = 0.0  # share of such a visit's scans after which it comes

    def is_there(self, visit: int, share: float) -> bool:
        return self.visits is None or (visit in self.visits and share >= self.since)


@dataclass(frozen=True, eq=False)
class Walker(Mover):
    """Someone or something that moves along its path but stands from stop_s on for a while."""

    stop_s: float = np.inf
    stand_s: float = 0.0

    def along(self, t_s):
        t = np.asarray(t_s, float)
        return super().along(t - np.clip(t - self.stop_s, 0, self.stand_s))


@dataclass(frozen=True, eq=False)
class World:
    """The ground as a function of xy (..., 2) -> (...), what stands on it, who moves about. wind: leaves move on."""

    things: Sequence[Thing]
    height: Callable[[np.ndarray], np.ndarray] = lambda xy: np.zeros(np.shape(xy)[:-1])
    movers: Sequence[Mover] = ()  # pass_index: their visit
    wind: bool = False

    def plus(self, *things: Thing, movers: tuple[Mover, ...] = (), wind: bool = False) -> "World":
        return World([*self.things, *things], self.height, [*self.movers, *movers], wind)

    def without(self, kind: str) -> "World":
        return replace(self, things=[thing for thing in self.things if thing.kind != kind])


@dataclass(frozen=True)
class Visit:
    """How the robot drives past, and what its poses are wrong by. Equal ones are driven once."""

    start: tuple[float, float] = (-3.0, 0.0)
    end: tuple[float, float] = (3.0, 0.0)
    n_scans: int = 8
    every_s: float = 0.8
    metadata: str = OS1_64
    error: np.ndarray | None = field(default=None, compare=False)  # T_map_true; None: the poses are true
    body: bool = False  # the sensor sees the robot that carries it
    lost: tuple[tuple[str, float], ...] = ()  # kind, and the share of its returns that do not come back


@dataclass(frozen=True, eq=False)
class Seen:
    """What a visit brought: scans, and of each change the surface met, one point (K, 3) for each 10 cm voxel."""

    sensor: Sensor
    scans: list[Scan]
    surface: dict[str, np.ndarray]


PAST = Visit()  # as most tests drive past


# Driving --------------------------------------------------------------------------------------------------------


def drive(world: World, number: int, visit: Visit = PAST) -> Seen:
    """The scans of one visit, decoded from packets, and the truth about the changes it saw."""
    things = tuple(thing for thing in world.things if thing.visits is None or number in thing.visits)
    movers = tuple(mover for mover in world.movers if mover.pass_index == number)
    seen = _driven(things, movers, world.height, world.wind, number, visit)
    if visit.error is None:
        return seen
    return replace(seen, scans=[replace(scan, T_map_sensor=visit.error @ scan.T_map_sensor) for scan in seen.scans])


@lru_cache(maxsize=16)  # the yard as nearly all tests first see it
def _driven(things, movers, height, wind, number: int, visit: Visit) -> Seen:
    """The visit at true poses."""
    world = World(things, height, movers, wind)
    sensor, encoder = _sensor(visit.metadata), _encoder(visit.metadata)
    shares = np.arange(visit.n_scans) / visit.n_scans
    scans, met, caster, there = [], {}, None, None
    for k, share in enumerate(shares):
        there_now = [thing.is_there(number, share) for thing in world.things]
        if wind or there_now != there:
            there = there_now
            pass_index = 1000 * number + (k if wind else 0)  # names the wind
            caster = Caster(_Moment(world, there, pass_index), pass_index, visit.body)
        index = number * VISIT_FRAMES + round(k * visit.every_s * 1e9 / encoder.period_ns)
        column_ns = encoder.column_ns(index)
        t_s = (column_ns - encoder.column_ns(number * VISIT_FRAMES)[0]) * 1e-9
        poses = _poses(world, visit, t_s)
        hits = caster.trace(sensor, poses, t_s)
        rng = np.random.default_rng([number, k])
        fields = receive(hits, sensor.pixel_shift, rng)
        _lose(fields, world, visit.lost, rng)
        frame = _decoded(encoder, encoder.packets(encoder.frame(index, fields)), sensor)
        scans.append(_scan(frame, number, k, poses))
        for i, thing in enumerate(world.things):
            if thing.visits is not None and there[i]:
                met.setdefault(thing.kind, []).append(_surface(sensor, poses, hits, fields["object"], i + 1))
    return Seen(sensor, scans, {kind: _voxels(np.concatenate(parts)) for kind, parts in met.items()})


@lru_cache(maxsize=8)
def submap(*visits: Seen) -> Submap:
    """The submap of all scans of some visits, which are numbered from 1 as the scans' ids say."""
    all_ = [(scan, seen.sensor) for seen in visits for scan in seen.scans]
    number = np.array([scan.scan_id // 1000 for scan, _ in all_])
    return build_submap(lambda i: all_[i], number, RANGE_M)[0]


def compare(world: World, first: Visit = PAST, second: Visit = PAST) -> "Outcome":
    """Two visits to a world, numbers 0 and 1, compared."""
    before, after = drive(world, 0, first), drive(world, 1, second)
    return Outcome(detected(submap(before), submap(after)), before, after)


def detected(cumulative: Submap, recent: Submap) -> Detection:
    """What the detector says with the default settings; no scans are left that a submap was not made of."""
    return detect(side_of(cumulative, THRESHOLDS), side_of(recent, THRESHOLDS), THRESHOLDS)


class _Moment:
    """A world at one moment, as the Caster wants it."""

    def __init__(self, world: World, there: list[bool], pass_index: int):
        self.items = [
            Item(thing.kind, thing.mesh, 0 if now else NEVER) for thing, now in zip(world.things, there, strict=True)
        ]
        self.movers = [replace(mover, pass_index=pass_index) for mover in world.movers]
        self.terrain, self.seed = world, 1
        self.kinds = ["nothing", *(item.kind for item in self.items), *("mover" for _ in self.movers), "vehicle"]


@cache
def _sensor(metadata: str) -> Sensor:
    return sensor_from_metadata(metadata)


@cache
def _encoder(metadata: str) -> Encoder:
    return Encoder(metadata)


def _poses(world: World, visit: Visit, t_s: np.ndarray) -> np.ndarray:
    """(W, 4, 4) T_world_sensor at times t_s (W,): level with the ground under the wheels."""
    start, end = np.array(visit.start), np.array(visit.end)
    share = np.clip(t_s / ((visit.n_scans - 1) * visit.every_s), 0, 1.1)[:, None]
    xy, ahead = start + share * (end - start), (end - start) / np.linalg.norm(end - start)
    left = np.array([-ahead[1], ahead[0]])
    wheels = [world.height(xy + d) for d in (0.4 * ahead, -0.4 * ahead, 0.3 * left, -0.3 * left)]
    pitch, roll = np.arctan2(wheels[1] - wheels[0], 0.8), np.arctan2(wheels[2] - wheels[3], 0.6)
    poses = np.tile(np.eye(4), (len(t_s), 1, 1))
    poses[:, :3, :3] = rotation(np.arctan2(ahead[1], ahead[0]), pitch, roll)
    poses[:, :2, 3] = xy
    poses[:, 2, 3] = np.mean(wheels, axis=0) + SENSOR_HEIGHT_M
    return poses


def _lose(fields: dict[str, np.ndarray], world: World, lost, rng: np.random.Generator) -> None:
    """Dark and wet surfaces: some of their returns do not come back."""
    for i, thing in enumerate(world.things):
        for share in (share for kind, share in lost if kind == thing.kind):
            gone = (fields["object"] == i + 1) & (rng.random(fields["object"].shape) < share)
            fields["RANGE"][gone] = 0


def _decoded(encoder: Encoder, packets: list, sensor: Sensor) -> Frame:
    assembler = FrameAssembler(encoder.info, Counter())
    frames = []
    for packet in packets:
        frames += assembler.add(assembler.packet(bytes(packet.buf), packet.host_timestamp))
    (frame,) = frames + list(assembler.flush())
    return frame_from_sdk(frame, sensor)


def _scan(frame: Frame, visit: int, k: int, poses: np.ndarray) -> Scan:
    return Scan(
        scan_id=1000 * (visit + 1) + k,
        session=1,
        stamp_ns=frame.stamp_ns,
        host_ns=frame.host_ns,
        frame_id=frame.frame_id,
        sensor_digest=frame.sensor.digest,
        range_mm=frame.range_mm,
        reflectivity=frame.reflectivity,
        column_ns=frame.column_ns,
        column_valid=frame.column_valid,
        T_map_sensor=poses[-1],
        T_odom_sensor=poses[-1],
        T_start_end=inverse(poses[0]) @ poses[-1],
        descriptor=np.zeros(256, np.float32),
        model_id="none",
        aligned=True,
        alignment_residual_m=0.0,
    )


def _surface(sensor: Sensor, poses: np.ndarray, hits: Hits, labels: np.ndarray, number: int) -> np.ndarray:
    """Where the beams met the thing of this number and brought something back, true points (K, 3).

    What lies behind its panes is not its surface: a third of the beams that go in bring something back.
    """
    mine = (labels == number) & (hits.object_id == number) & (hits.clarity == 1)
    row, column = np.nonzero(mine & (hits.range_m < RANGE_M))
    local = sensor.direction[row, column] * hits.range_m[row, column, None] + sensor.offset[row, column]
    return np.einsum("kij,kj->ki", poses[column, :3, :3], local) + poses[column, :3, 3]


def _voxels(points: np.ndarray) -> np.ndarray:
    """The mean point of each voxel."""
    _, group = np.unique(np.floor(points / SURFACE_VOXEL_M).astype(np.int64), axis=0, return_inverse=True)
    group = group.ravel()
    return np.stack([np.bincount(group, points[:, i]) for i in range(3)], axis=1) / np.bincount(group)[:, None]


def error(x_m=0.0, y_m=0.0, z_m=0.0, yaw_deg=0.0, pitch_deg=0.0, roll_deg=0.0) -> np.ndarray:
    """T_map_true (4, 4): turned about the origin, then shifted."""
    T = np.eye(4)
    T[:3, :3] = rotation(*np.radians([yaw_deg, pitch_deg, roll_deg]))
    T[:3, 3] = x_m, y_m, z_m
    return T


# Judging --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was detected between two visits, and what they saw."""

    detection: Detection
    before: Seen
    after: Seen

    def expect(self, appeared: dict[str, float] | None = None, disappeared: dict[str, float] | None = None) -> None:
        """Each kind found exactly once, with at least this share of its visible surface; and nothing else."""
        left = list(self.detection.objects)
        faults = []
        for polarity, wanted, seen in (
            ("appeared", appeared, self.after),
            ("disappeared", disappeared, self.before),
        ):
            for kind, least in (wanted or {}).items():
                surface = seen.surface[kind]
                mine = [o for o in left if o.polarity == polarity and _is_of(o, surface)]
                left = [o for o in left if o not in mine]
                if len(mine) != 1:
                    faults.append(f"{kind} {polarity} found {len(mine)} times: {[_line(o) for o in mine]}")
                elif coverage(mine[0], surface) < least:
                    faults.append(f"{kind} {polarity}: {coverage(mine[0], surface):.2f} of {len(surface)} covered")
        faults += [f"besides: {_line(o)}" for o in left]
        assert not faults, "\n".join(faults)


def coverage(found: DetectedObject, surface: np.ndarray) -> float:
    """Share of a surface (K, 3) that has a reported point near."""
    return float((cKDTree(found.points).query(surface)[0] < COVERED_M).mean())


def _is_of(found: DetectedObject, surface: np.ndarray) -> bool:
    return float((cKDTree(surface).query(found.points)[0] < OWN_M).mean()) > 0.5


def _line(found: DetectedObject) -> str:
    size = np.ptp(found.points, axis=0)
    middle = found.points.mean(axis=0)
    return (
        f"{found.polarity} at {middle.round(2).tolist()}, size {size.round(2).tolist()}, {len(found.points)} points, "
        f"{found.n_confirmed} confirmed, shown by {found.n_seen_by} scans, looked through by {found.n_confirming}"
    )


# Worlds ---------------------------------------------------------------------------------------------------------


def ground(height: Callable[[np.ndarray], np.ndarray], half_m: float = 30.0, cell_m: float = 0.5) -> Mesh:
    """The ground as a grid about the origin, a little rough; soil."""
    xs = np.arange(-half_m, half_m + cell_m / 2, cell_m)
    xy = np.stack(np.meshgrid(xs, xs, indexing="ij"), -1)
    z = height(xy) + np.random.default_rng(5).normal(0, 0.006, xy.shape[:2])
    index = np.arange(z.size, dtype=np.int32).reshape(z.shape)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.concatenate([xy, z[..., None]], -1).reshape(-1, 3).astype(np.float32)
    return Mesh(vertices, faces, np.full(len(faces), Material.SOIL, np.uint8))


def open_field(height: Callable[[np.ndarray], np.ndarray] | None = None, cell_m: float = 0.5) -> World:
    """Nothing but ground."""
    height = height or World([]).height
    return World([Thing("ground", ground(height, cell_m=cell_m))], height)


@cache
def house() -> Building:
    """Its front 10.5 m to the left of the path, its door at x = door_xyz[0]."""
    made = building(np.random.default_rng(11), 16.0, 8.0, 5.5)
    parts = [part.moved((0, 14.5, 0)) for part in (made.body, made.door_shut, made.door_open)]
    return Building(*parts, made.door_xyz + [0, 14.5, 0], made.size)


@cache
def yard() -> World:
    """Between a house and a wall: a parked car, a tree, a bush, a lamp, a bench. Room from y = 2 to 9, and -3 to -8."""
    rng = np.random.default_rng(11)
    wall = merge(
        [box((44, 0.3, 2.4), Material.BRICK, (0, -9.5, 0))]
        + [box((0.4, 0.5, 2.5), Material.BRICK, (x, -9.4, 0)) for x in range(-20, 21, 5)]
    )
    return open_field().plus(
        Thing("house", house().body),
        Thing("house door", house().door_shut),
        Thing("wall", wall),
        Thing("container", shapes.container(rng).moved((17, 3, 0), yaw=1.5)),
        Thing("container", shapes.container(rng).moved((-18, -1, 0), yaw=1.7)),
        Thing("car", car(rng, "wagon").shut.moved((-8.5, 5.5, 0), yaw=0.1)),
        Thing("tree", shapes.tree(rng, 900).moved((9.5, -5.5, 0))),
        Thing("bush", shapes.bush(rng).moved((-8, -8, 0))),
        Thing("lamp", shapes.lamp(rng).moved((6.5, 8.6, 0), yaw=-1.5)),
        Thing("bench", shapes.bench(rng).moved((-9, -4.5, 0))),
    )


def walker(
    path: list[tuple[float, float]], visit: int, speed_m_s: float = 1.2, seed: int = 0, stop_s=np.inf, stand_s=0.0
) -> Walker:
    """Someone who walks along corners (K, 2), and back."""
    meshes = tuple(shapes.person(np.random.default_rng(seed), stride) for stride in GAIT)
    return Walker("walker", meshes, _line_through(path), visit, speed_m_s, 0.0, stop_s, stand_s)


def driver(path: list[tuple[float, float]], visit: int, speed_m_s: float, seed: int = 0) -> Walker:
    """A car that drives along corners (K, 2)."""
    mesh = car(np.random.default_rng(seed)).shut
    return Walker("driver", (mesh,), _line_through(path), visit, speed_m_s, 0.0)


def _line_through(corners: list[tuple[float, float]]) -> Route:
    corners = np.array(corners, float)
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0, s[-1], 0.05)
    return Route(np.stack([np.interp(at, s, corners[:, i]) for i in range(2)], 1), closed=False)
