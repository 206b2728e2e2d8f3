"""Corrects odometry: T_map_odom, by fitting key scans to a scene's first visit, or to the key scans before."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from .config import AlignmentConfig
from .geometry import inverse, rotation_angle_rad
from .local_map import LocalMap
from .odometry import Motion
from .reference_map import COARSE_VOXEL_M, ReferenceMap
from .registration import align, scan_cloud
from .scenes import Scene
from .sweep import STEADY, Sweep
from .sweep_fit import SweepFit, fit_sweep
from .voxels import Moments

CACHED_REFERENCES = 5  # those in play, at most three where scenes overlap, and those the robot may come to next
MAX_TURN_DEG = 8.0  # a correction that turns the map further is a wrong match, not drift
MAX_SEAM_M = 0.1  # a fix that moves the map further leaves the last key scans where they are no longer true
MIN_COARSE_TRAVEL_M = 5.0  # metres without a fix after which a large drift is looked for at once


@dataclass(frozen=True, eq=False)
class Fix:
    """Where a key scan was: T_map_sensor (4, 4) at the end of the steady motion T_start_end (4, 4) nearest to its own.

    bend (6,): how far it was off that, see Sweep; aligned says whether a stored scene confirmed it.
    """

    T_map_sensor: np.ndarray
    T_start_end: np.ndarray
    bend: np.ndarray
    aligned: bool
    residual_m: float  # root mean square distance to the reference's surface; NaN without a reference
    reason: str


class Localizer:
    """Keeps T_map_odom up to date.

    load_reference(scene) gives the cells of one scan of the scene's first visit after another, in the map.
    """

    def __init__(
        self,
        config: AlignmentConfig,
        load_reference: Callable[[Scene], Iterator[Moments]],
        T_map_odom: np.ndarray,
    ):
        self._config = config
        self._load_reference = load_reference
        self._references: OrderedDict[int, ReferenceMap] = OrderedDict()
        self._local_map = LocalMap(config.plane_voxel_m, config.local_scans)
        self._last_position: np.ndarray | None = None
        self._travel_since_fix_m = 0.0
        self.T_map_odom = T_map_odom

    @property
    def reach_m(self) -> float:
        """How far off the position may be by drift since the last fix, metres."""
        return self._config.drift_ratio * self._travel_since_fix_m

    def predict(self, T_odom_sensor: np.ndarray) -> np.ndarray:
        """T_map_sensor (4, 4) by odometry and the last fix."""
        return self.T_map_odom @ T_odom_sensor

    def locate(self, sweep: Sweep, motion: Motion, scenes: list[Scene]) -> Fix:
        """Pose and motion of a key scan, from the odometry's.

        scenes: the known scenes that the robot may be in, nearest first; without one the prediction stands.
        """
        self._travel(motion.T_odom_sensor)
        fix = self._fix(sweep, self.predict(motion.T_odom_sensor), motion.T_start_end, scenes)
        self._local_map.add(sweep.in_map(fix.T_map_sensor, fix.T_start_end, fix.bend))
        self.T_map_odom = fix.T_map_sensor @ inverse(motion.T_odom_sensor)
        return fix

    def prepare(self, scenes: list[Scene]) -> None:
        """Read one more scan of the nearest of the scenes (nearest first) whose first visit is not in memory yet.

        Asked at each key scan for the scenes ahead, it has them when the robot is there: reading one at a stroke would
        take as long as five frames.
        """
        for scene in scenes[:CACHED_REFERENCES]:  # more would push one another out
            if self._reference(scene).build_on():
                return

    def _fix(self, sweep: Sweep, predicted: np.ndarray, T_start_end: np.ndarray, scenes: list[Scene]) -> Fix:
        """By a known scene; where none matches, by the key scans before."""
        reason = "new place"
        drifted = self._travel_since_fix_m > MIN_COARSE_TRAVEL_M
        attempts = [(scene, coarse) for coarse in (drifted, True) for scene in scenes[:2]]
        for scene, coarse in dict.fromkeys(attempts):
            reference = self._reference(scene)
            if not reference.complete():
                del self._references[scene.scene_id]  # the disk may have taken its scans by the next time
                reason = "nothing is stored of the scene's first visit"
                continue
            fit = self._register(sweep, predicted, T_start_end, reference, coarse)
            reason = self._objection(fit, predicted)
            if not reason:
                self._travel_since_fix_m = 0.0
                if np.linalg.norm(fit.T_map_sensor[:3, 3] - predicted[:3, 3]) > MAX_SEAM_M:
                    self._local_map.clear()
                return Fix(fit.T_map_sensor, fit.T_start_end, fit.bend, True, fit.residual_m, "")
        fit = self._local_map.refine(sweep, predicted, T_start_end)
        if fit is None:
            return Fix(predicted, T_start_end, STEADY, False, float("nan"), reason)
        return Fix(fit.T_map_sensor, fit.T_start_end, fit.bend, False, float("nan"), reason)

    def _travel(self, T_odom_sensor: np.ndarray) -> None:
        position = T_odom_sensor[:3, 3].copy()
        if self._last_position is not None:
            self._travel_since_fix_m += float(np.linalg.norm(position - self._last_position))
        self._last_position = position

    def _register(
        self, sweep: Sweep, predicted: np.ndarray, T_start_end: np.ndarray, reference: ReferenceMap, coarse: bool
    ) -> SweepFit:
        T = predicted
        if coarse:
            scan = scan_cloud(sweep.at_end(T_start_end), COARSE_VOXEL_M, self._config.range_m)
            T = align(scan, reference.surface(), T, self._config.coarse_gate_m)
        return fit_sweep(sweep, T, T_start_end, reference.planes_at, self._config.gate_m)

    def _objection(self, fit: SweepFit, predicted: np.ndarray) -> str:
        """Why a match is not believed; empty when it is."""
        correction = inverse(predicted) @ fit.T_map_sensor
        moved = float(np.linalg.norm(correction[:3, 3]))
        turned = np.degrees(rotation_angle_rad(correction))
        if fit.known_ratio < self._config.min_inlier_ratio:
            return f"only {fit.known_ratio:.0%} of the scan lies on the scene's first visit"
        if fit.residual_m > self._config.max_residual_m:
            return f"{fit.residual_m:.2f} m off the scene's first visit"
        if moved > self._config.coarse_gate_m + self.reach_m or turned > MAX_TURN_DEG:
            return f"correction of {moved:.1f} m and {turned:.0f} deg is not believed"
        return ""

    def _reference(self, scene: Scene) -> ReferenceMap:
        if scene.scene_id not in self._references:
            scans = self._load_reference(scene)
            self._references[scene.scene_id] = ReferenceMap(scans, self._config.plane_voxel_m)
            if len(self._references) > CACHED_REFERENCES:
                self._references.popitem(last=False)
        self._references.move_to_end(scene.scene_id)
        return self._references[scene.scene_id]
