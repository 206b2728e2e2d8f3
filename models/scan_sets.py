"""Virtual scans with their true overlaps: what the descriptor is trained, calibrated and measured on.

Seeds of worlds keep the three sets apart: no world of validation or test is ever trained on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..drivers.frame import Sensor
from ..drivers.metadata import sensor_from_metadata
from ..drivers.virtual.mesh import rotation
from ..drivers.virtual.raycast import Caster
from ..drivers.virtual.sensor import receive, virtual_metadata
from ..drivers.virtual.worlds import World, random_world
from .overlap import RangeView, overlap_matrix, view_of_scan
from .preprocess import Resampler

FIRST_SEED = {"train": 1_000_000, "validation": 2_000_000, "test": 3_000_000}
SCANS_PER_WORLD = 120
SCENARIOS = ("quiet", "short", "demo")
ROUTE_M = (70.0, 220.0)
# Beams and columns of a world's sensor and how often each is drawn; sparser ones are made from these.
SENSORS = (((64, 512), 0.6), ((64, 1024), 0.25), ((128, 1024), 0.15))
FIRST_OS1_FOV_DEG = 16.6  # half the field of view of the first OS1-64s
REFERENCE_BEAMS, REFERENCE_COLUMNS = 64, 512
OVERLAP_POINTS = 1024

NEIGHBOURS = 3
ON_ROUTE = 0.6
EDGE_M = 12.0
HEIGHT_M = (0.4, 2.5)
TILT_DEG = 1.5
SPEED_M_S = 8.0  # a street drive bends each scan by most of a metre
TURN_RATE_DEG_S = 6.0
ROTATION_S = 0.1


@dataclass(frozen=True, eq=False)
class WorldScans:
    """N scans of one world through one sensor: staggered ranges, geometry and truth.

    range_mm: (N, H, W) uint32; pixel_shift: (H,) int; altitude_rad: (H,) float32; T_world_sensor: (N, 4, 4)
    float64; season: (N,) int, the state of the world (its movers and changed objects) in which each scan
    was taken; azimuth_0_rad: azimuth of the destaggered column 0.
    """

    range_mm: np.ndarray
    pixel_shift: np.ndarray
    altitude_rad: np.ndarray
    azimuth_0_rad: float
    T_world_sensor: np.ndarray
    season: np.ndarray

    def views(self) -> list[RangeView]:
        """One view per scan, thinned to the reference sensor's beams and columns."""
        beams, columns = max(len(self.altitude_rad), REFERENCE_BEAMS), self.range_mm.shape[2]
        rows = slice(0, None, beams // REFERENCE_BEAMS)
        step = columns // REFERENCE_COLUMNS
        shift, altitude = self.pixel_shift[rows] // step, self.altitude_rad[rows]
        return [view_of_scan(image[rows, ::step], shift, altitude, self.azimuth_0_rad) for image in self.range_mm]

    def overlaps(self) -> np.ndarray:
        """(N, N) float32 true overlap of every pair."""
        return overlap_matrix(self.views(), self.T_world_sensor, OVERLAP_POINTS)

    def distances_m(self) -> np.ndarray:
        """(N, N) float64 distance between the sensor positions of every pair, metres."""
        position = self.T_world_sensor[:, :3, 3]
        return np.linalg.norm(position[:, None] - position[None], axis=2)

    def seen_by(self, beam_step: int, column_step: int, altitude_limit_rad: float = np.inf) -> WorldScans:
        """The same scans through a sensor with fewer beams and columns, and perhaps a narrower view."""
        rows = np.flatnonzero(np.abs(self.altitude_rad) <= altitude_limit_rad)[::beam_step]
        return replace(
            self,
            range_mm=self.range_mm[:, rows, ::column_step],
            pixel_shift=self.pixel_shift[rows] // column_step,
            altitude_rad=self.altitude_rad[rows],
        )

    def turned(self, columns: int) -> WorldScans:
        """The same scans by a sensor that faces elsewhere, by some of its columns; T_world_sensor is as it was."""
        return replace(self, range_mm=np.roll(self.range_mm, columns, axis=2))

    def inputs(self) -> np.ndarray:
        """(N, *INPUT_SHAPE) float32: the network's inputs."""
        resample = Resampler(self.pixel_shift, self.altitude_rad, self.range_mm.shape[2])
        return np.stack([resample(image) for image in self.range_mm])


@dataclass(frozen=True, eq=False)
class CachedWorld:
    """The scans of the world of a seed as the network's inputs: (V, N, 3, 32, 256) float16, each through V
    sensors; and their true overlaps, (N, N) float32.
    """

    seed: int
    inputs: np.ndarray
    overlap: np.ndarray


def anywhere(world: World, rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 2) metres: anchors on the route and elsewhere, each with neighbours at 0.2 to 20 m."""
    terrain, route = world.terrain, world.route
    inner = terrain.bounds + np.array([[EDGE_M], [-EDGE_M]])
    n_anchors = -(-n // (1 + NEIGHBOURS))
    on_route = route.beside(rng.uniform(0, route.length_m, n_anchors), rng.normal(0, 1.5, n_anchors))
    off_route = rng.uniform(inner[0], inner[1], (n_anchors, 2))
    anchors = np.where(rng.random((n_anchors, 1)) < ON_ROUTE, on_route, off_route)
    reach = np.exp(rng.uniform(np.log(0.2), np.log(20.0), (NEIGHBOURS, n_anchors, 1)))
    bearing = rng.uniform(0, 2 * np.pi, (NEIGHBOURS, n_anchors))
    around = anchors + reach * np.stack((np.cos(bearing), np.sin(bearing)), axis=-1)
    return np.clip(np.concatenate((anchors[None], around)).reshape(-1, 2)[:n], inner[0], inner[1])


def along_route(world: World, rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 2) metres: where a patrol would pass."""
    return world.route.beside(rng.uniform(0, world.route.length_m, n), rng.normal(0, 0.8, n))


def _one_or_the_other(world: World, rng: np.random.Generator, n: int) -> np.ndarray:
    """(n, 2) metres: half of the worlds are patrolled, the others roamed."""
    return (along_route if rng.random() < 0.5 else anywhere)(world, rng, n)


def _poses(world: World, rng: np.random.Generator, xy: np.ndarray) -> np.ndarray:
    """(n, 4, 4) T_world_sensor at (n, 2) metres, any yaw, one mounting height for all."""
    n = len(xy)
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, :3] = rotation(rng.uniform(-np.pi, np.pi, n), *rng.normal(0, np.deg2rad(TILT_DEG), (2, n)))
    pose[:, :2, 3] = xy
    pose[:, 2, 3] = world.terrain.slope_height(xy) + rng.uniform(*HEIGHT_M) + rng.normal(0, 0.05, n)
    return pose


def scan_world(seed: int, n: int, beams: int, columns: int, places: Callable[..., np.ndarray] = anywhere) -> WorldScans:
    """About n scans of the world of a seed, at `places`; those that stand inside something are left out."""
    rng = np.random.default_rng((seed, 7))
    world = random_world(seed, str(rng.choice(SCENARIOS)), float(rng.uniform(*ROUTE_M)))
    sensor = sensor_from_metadata(virtual_metadata(beams, columns, serial=122_300_000_000 + seed))
    poses = _poses(world, rng, places(world, rng, n))
    seasons = rng.integers(world.scenario.passes, size=n)
    images = np.empty((n, *sensor.shape), np.uint32)
    for season in np.unique(seasons):
        caster = Caster(world, int(season))
        for index in np.flatnonzero(seasons == season):
            hits = caster.trace(
                sensor, _poses_of_columns(poses[index], rng, columns), _times(world, season, rng, columns)
            )
            images[index] = receive(hits, sensor.pixel_shift, rng)["RANGE"]
    kept = np.array([_is_outside(image, sensor) for image in images])
    return WorldScans(
        images[kept],
        sensor.pixel_shift,
        sensor.altitude_rad,
        _azimuth_of_first_column(sensor),
        poses[kept],
        seasons[kept],
    )


def cached_world(folder: Path, seed: int) -> CachedWorld:
    """The world of a seed; its scans come from the folder's cache or are newly made into it."""
    path = folder / f"{seed}.npz"
    if not path.exists():
        _make(seed, path)
    with np.load(path) as stored:
        fields = {name: stored[name] for name in stored.files}
    overlap = fields.pop("overlap")
    return _through_sensors(WorldScans(**fields), overlap, seed)


def _make(seed: int, path: Path) -> None:
    """Scans a world and computes its overlaps into one file; a file of this name is always whole."""
    rng = np.random.default_rng((seed, 8))
    kinds, chances = zip(*SENSORS, strict=True)
    scans = scan_world(seed, SCANS_PER_WORLD, *kinds[rng.choice(len(kinds), p=chances)], _one_or_the_other)
    unfinished = path.with_suffix(".tmp.npz")
    np.savez(unfinished, overlap=scans.overlaps(), **vars(scans))
    unfinished.replace(path)


def _through_sensors(scans: WorldScans, overlap: np.ndarray, seed: int) -> CachedWorld:
    """One world's scans as inputs through three sensors: its own, an OS1-32, one with a narrow view.

    They face differently: a turn by part of an input column changes the inputs, and must not change the descriptor.
    """
    rng = np.random.default_rng((seed, 9))
    _, beams, columns = scans.range_mm.shape
    narrow_step = int(rng.choice((1, 2)))
    sensors = (
        scans,
        scans.seen_by(beams // 32, columns // 512),
        scans.seen_by(narrow_step, 1, np.deg2rad(FIRST_OS1_FOV_DEG)),
    )
    turned = (sensor.turned(int(rng.integers(sensor.range_mm.shape[2]))) for sensor in sensors)
    inputs = np.stack([sensor.inputs() for sensor in turned]).astype(np.float16)
    return CachedWorld(seed, inputs, overlap)


def _poses_of_columns(T_world_sensor: np.ndarray, rng: np.random.Generator, columns: int) -> np.ndarray:
    """(columns, 4, 4): the sensor drives and turns while it scans, and ends at the given pose."""
    before_end_s = np.linspace(-ROTATION_S, 0.0, columns)
    turned = rotation(before_end_s * np.deg2rad(rng.normal(0, TURN_RATE_DEG_S)))
    bearing, speed = rng.uniform(-np.pi, np.pi), rng.uniform(0, SPEED_M_S)
    moved = np.tile(np.eye(4), (columns, 1, 1))
    moved[:, :3, :3] = turned
    moved[:, 0, 3], moved[:, 1, 3] = (before_end_s * speed * side for side in (np.cos(bearing), np.sin(bearing)))
    return T_world_sensor @ moved


def _times(world: World, season: int, rng: np.random.Generator, columns: int) -> np.ndarray:
    """(columns,) seconds of one rotation somewhere in the pass: they place the people and cars."""
    ends = [*world.patrol.pass_start_s, world.patrol.duration_s]
    return rng.uniform(ends[season], ends[season + 1]) + np.linspace(-ROTATION_S, 0.0, columns)


def _is_outside(range_mm: np.ndarray, sensor: Sensor) -> bool:
    """Whether the sky shows and little is close by: false inside houses, hedges and cars."""
    high = range_mm[sensor.altitude_rad > np.deg2rad(12.0)]
    close = (range_mm > 0) & (range_mm < 1000)
    return (high > 0).mean() < 0.9 and close.mean() < 0.15 and (range_mm > 0).mean() > 0.4


def _azimuth_of_first_column(sensor: Sensor) -> float:
    """Mean azimuth of the destaggered image's column 0, radians."""
    first = sensor.direction[np.arange(sensor.shape[0]), -sensor.pixel_shift % sensor.shape[1]]
    return float(np.arctan2(first[:, 1].mean(), first[:, 0].mean()))
