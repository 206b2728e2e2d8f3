"""Where in the earlier maps a key scan was taken: stored scenes that look alike, then geometry, then doubt.

Descriptors choose the scenes, plans the poses in them (plan.py), GICP verifies. A wrong answer would write false
changes into a store that lives for years, so a pose is believed only if what stands upright fits and no other does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..storage.errors import ScanFileError
from ..storage.rows import SceneScans
from ..storage.store import Store
from .config import AlignmentConfig
from .geometry import inverse, rotation_angle_rad
from .plan import APART_DEG, APART_M, Guess, PlacePlan, ScanPlan
from .references import REFERENCE_SCANS, reference_points
from .registration import Match, Surface, align, judge, scan_cloud, surface_of
from .sensors import Sensors
from .views import sensor_points

SCENES = 20  # nearest by descriptor, which is not always right at once
GUESSES_PER_SCENE = 3
GUESSES = 6  # verified, best plans first
PLAN_SCANS = 5  # of a scene's first visit
COARSE_VOXEL_M = 0.6
MIN_COARSE_UPRIGHT = 0.35  # below, the fine registration is not worth its time
# On virtual worlds a right pose has 0.9 of what stands upright, 0.95 of all; a wrong one 0.25 and 0.6.
MIN_UPRIGHT = 0.7
MIN_INLIERS = 0.8
MIN_UPRIGHT_POINTS = 500  # on an open field nothing tells one place from another
CLEARLY = 0.2  # the second best pose must be so much worse
SAME_M, SAME_DEG = 1.0, 5.0  # poses nearer than both are one
CACHED_PLACES, CACHED_SURFACES = 20, 2  # 3 MB and 13 MB each


@dataclass(frozen=True, eq=False)
class Question:
    """Which key scan to locate, and in which maps, the preferred one first."""

    session: int
    scan_id: int
    maps: list[int]
    alignment: AlignmentConfig


@dataclass(frozen=True, eq=False)
class Answer:
    """The best pose of the scan in a map, T_map_sensor (4, 4) at its end, and why it is not to be believed."""

    map_id: int
    T_map_sensor: np.ndarray
    reason: str  # empty where it is


@dataclass(frozen=True, eq=False)
class Place:
    """A stored scene, as it is looked through for a pose."""

    map_id: int
    scene_id: int
    plan: PlacePlan
    surface: Surface  # coarse


class Relocator:
    """Answers questions from one data directory, beside its writer."""

    def __init__(self, data: Path, alignment: AlignmentConfig):
        self._store = Store.open_reader(data)
        self._sensors = Sensors(self._store.dir)
        self._alignment = alignment
        self._place = lru_cache(CACHED_PLACES)(self._load_place)
        self._surface = lru_cache(CACHED_SURFACES)(self._load_surface)

    def locate(self, question: Question) -> Answer:
        """Raises ScanFileError where a scan's file is damaged or gone."""
        scan = self._store.scans.read(question.session, question.scan_id)
        points = sensor_points(scan, self._sensors.get(scan.sensor_digest), self._alignment.range_m)
        return self.find(points, scan.descriptor, scan.model_id, question.maps)

    def find(self, points: np.ndarray, descriptor: np.ndarray, model_id: str, maps: list[int]) -> Answer:
        """Where a scan was taken: returns (N, 3) float32 metres, sensor frame; descriptor (D,) by a model."""
        places = self._places_like(descriptor, model_id, maps)
        verify = Verifier(points, self._alignment, self._surface)
        matches: dict[int, list[Match]] = {map_id: [] for map_id in maps}
        for guess, place in best_guesses(ScanPlan(points), places):
            matches[place.map_id].append(verify(guess.T_map_sensor, place))
        answers = [verdict(map_id, matches[map_id], self._alignment.max_residual_m) for map_id in maps]
        return next((answer for answer in answers if not answer.reason), answers[0])

    def close(self) -> None:
        """Forget all places now: a cache of one's own methods is a circle, which Python breaks when it likes."""
        self._place.cache_clear()
        self._surface.cache_clear()
        self._store.close()

    def _places_like(self, descriptor: np.ndarray, model_id: str, maps: list[int]) -> list[Place]:
        """The scenes of these maps whose scans lie nearest by descriptor; last, those that another model described."""
        index = self._store.index
        scenes, descriptors = index.scene_descriptors(model_id, maps)
        ranked = scenes[np.argsort(-(descriptors @ descriptor), kind="stable")] if len(scenes) else scenes
        map_of = {row.scene_id: map_id for map_id in maps for row in index.scenes(map_id)}
        nearest = list(dict.fromkeys([*ranked.tolist(), *map_of]))[:SCENES]
        places = [self._place(map_of[scene_id], scene_id) for scene_id in nearest]
        return [place for place in places if place is not None]

    def _load_place(self, map_id: int, scene_id: int) -> Place | None:
        """None where no scan of the scene's first visit is left."""
        first_visit = self._store.index.scans_of_scene(scene_id, visit=1)
        try:
            points = self._points(first_visit, PLAN_SCANS)
        except ScanFileError:
            return None
        return Place(map_id, scene_id, PlacePlan(points, first_visit.T_map_sensor), surface_of(points, COARSE_VOXEL_M))

    def _load_surface(self, scene_id: int) -> Surface:
        first_visit = self._store.index.scans_of_scene(scene_id, visit=1)
        return surface_of(self._points(first_visit, REFERENCE_SCANS), self._alignment.voxel_m)

    def _points(self, first_visit: SceneScans, n_scans: int) -> np.ndarray:
        return reference_points(first_visit, self._store.scans, self._sensors, self._alignment.range_m, n_scans)


def best_guesses(scan: ScanPlan, places: list[Place]) -> list[tuple[Guess, Place]]:
    """The poses in all places at which a scan's plan fits best, best first; scenes overlap, poses do not."""
    guesses = [(guess, place) for place in places for guess in place.plan.guesses(scan, GUESSES_PER_SCENE)]
    guesses.sort(key=lambda pair: -pair[0].score)
    distinct: list[tuple[Guess, Place]] = []
    for guess, place in guesses:
        alike = (
            other.map_id == place.map_id and same_pose(guess.T_map_sensor, known.T_map_sensor, APART_M, APART_DEG)
            for known, other in distinct
        )
        if not any(alike):
            distinct.append((guess, place))
    return distinct[:GUESSES]


class Verifier:
    """Registers one scan, returns (N, 3) float32 metres in the sensor frame, to places at guessed poses."""

    def __init__(self, points: np.ndarray, alignment: AlignmentConfig, surface: Callable[[int], Surface]):
        self._alignment, self._surface = alignment, surface
        self._coarse = scan_cloud(points, COARSE_VOXEL_M, alignment.range_m)
        self._fine = scan_cloud(points, alignment.voxel_m, alignment.range_m)

    def __call__(self, T_map_sensor: np.ndarray, place: Place) -> Match:
        """The fine registration where the coarse one leaves hope, else the coarse one."""
        T = align(self._coarse, place.surface, T_map_sensor, self._alignment.coarse_gate_m)
        coarse = judge(T, self._coarse, place.surface, self._alignment.gate_m)
        if coarse.upright_ratio < MIN_COARSE_UPRIGHT:
            return coarse
        surface = self._surface(place.scene_id)
        T = align(self._fine, surface, T, self._alignment.gate_m)
        return judge(T, self._fine, surface, self._alignment.gate_m)


def verdict(map_id: int, matches: list[Match], max_residual_m: float) -> Answer:
    """Whether the best of some poses in one map is to be believed."""
    if not matches:
        return Answer(map_id, np.full((4, 4), np.nan), "nothing stored looks like it")
    best = max(matches, key=lambda match: match.upright_ratio)
    others = [m for m in matches if not same_pose(m.T_map_sensor, best.T_map_sensor, SAME_M, SAME_DEG)]
    rival = max((match.upright_ratio for match in others), default=0.0)
    reason = ""
    if best.upright_ratio < MIN_UPRIGHT or best.inlier_ratio < MIN_INLIERS:
        reason = f"at best {best.inlier_ratio:.0%} of the scan and {best.upright_ratio:.0%} of its upright parts fit"
    elif best.n_upright < MIN_UPRIGHT_POINTS:
        reason = f"only {best.n_upright} points of what stands upright are in sight"
    elif best.residual_m > max_residual_m:
        reason = f"{best.residual_m:.2f} m off the stored scans"
    elif rival > best.upright_ratio - CLEARLY:
        reason = f"{rival:.0%} of the upright parts fit at another pose too, {best.upright_ratio:.0%} at the best"
    return Answer(map_id, best.T_map_sensor, reason)


def same_pose(T_a: np.ndarray, T_b: np.ndarray, within_m: float, within_deg: float) -> bool:
    """Whether two poses (4, 4) differ by less than both limits."""
    between = inverse(T_a) @ T_b
    return bool(np.linalg.norm(between[:3, 3]) < within_m and np.degrees(rotation_angle_rad(between)) < within_deg)
