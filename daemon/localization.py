"""Corrects odometry: T_map_odom, by registering key scans to a scene's first visit, or to the key scans before."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import small_gicp

from ..storage.errors import ScanFileError
from .config import AlignmentConfig
from .geometry import inverse, rotation_angle_rad
from .local_map import LocalMap
from .registration import Match, Surface, align, judge, scan_cloud, surface_of
from .scenes import Scene

CACHED_REFERENCES = 3  # scenes overlap at their rims; more than that are never in play at once
MAX_TURN_DEG = 8.0  # a correction that turns the map further is a wrong match, not drift
MAX_SEAM_M = 0.1  # a fix that moves the map further leaves the last key scans where they are no longer true
MIN_COARSE_TRAVEL_M = 5.0  # metres without a fix after which a large drift is looked for at once


@dataclass(frozen=True, eq=False)
class Fix:
    """Where a key scan was: T_map_sensor (4, 4) at its end; aligned says whether a stored scene confirmed it."""

    T_map_sensor: np.ndarray
    aligned: bool
    residual_m: float  # root mean square distance to the reference's surface; NaN without a reference
    reason: str


class Localizer:
    """Keeps T_map_odom up to date.

    load_reference(scene) gives points (N, 3) float32 of the scene's first visit in the map frame; it raises
    ScanFileError where none of its scans is left.
    """

    def __init__(self, config: AlignmentConfig, load_reference: Callable[[Scene], np.ndarray], T_map_odom: np.ndarray):
        self._config = config
        self._load_reference = load_reference
        self._references: OrderedDict[int, Surface] = OrderedDict()
        self._local_map = LocalMap(config.local_voxel_m, config.local_scans)
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

    def locate(self, points: np.ndarray, T_odom_sensor: np.ndarray, scenes: list[Scene]) -> Fix:
        """Pose of a key scan with returns (N, 3) float32, deskewed to the sensor frame at its end.

        scenes: the known scenes that the robot may be in, nearest first; without one the prediction stands.
        """
        self._travel(T_odom_sensor)
        source = scan_cloud(points, self._config.voxel_m, self._config.range_m)
        fix = self._fix(source, self.predict(T_odom_sensor), scenes)
        self._local_map.add(source, fix.T_map_sensor)
        self.T_map_odom = fix.T_map_sensor @ inverse(T_odom_sensor)
        return fix

    def _fix(self, source: small_gicp.PointCloud, predicted: np.ndarray, scenes: list[Scene]) -> Fix:
        """By a known scene; where none matches, by the key scans before."""
        reason = "new place"
        drifted = self._travel_since_fix_m > MIN_COARSE_TRAVEL_M
        attempts = [(scene, coarse) for coarse in (drifted, True) for scene in scenes[:2]]
        for scene, coarse in dict.fromkeys(attempts):
            try:
                match = self._register(source, predicted, scene, coarse)
            except ScanFileError as why:
                reason = str(why)
                continue
            reason = self._objection(match, predicted)
            if not reason:
                self._travel_since_fix_m = 0.0
                if np.linalg.norm(match.T_map_sensor[:3, 3] - predicted[:3, 3]) > MAX_SEAM_M:
                    self._local_map.clear()
                return Fix(match.T_map_sensor, True, match.residual_m, "")
        return Fix(self._local_map.refine(source, predicted), False, float("nan"), reason)

    def _travel(self, T_odom_sensor: np.ndarray) -> None:
        position = T_odom_sensor[:3, 3].copy()
        if self._last_position is not None:
            self._travel_since_fix_m += float(np.linalg.norm(position - self._last_position))
        self._last_position = position

    def _register(self, source: small_gicp.PointCloud, predicted: np.ndarray, scene: Scene, coarse: bool) -> Match:
        gates = [self._config.coarse_gate_m, self._config.gate_m] if coarse else [self._config.gate_m]
        T, surface = predicted, self._reference(scene)
        for gate in gates:
            T = align(source, surface, T, gate)
        return judge(T, source, surface, self._config.gate_m)

    def _objection(self, match: Match, predicted: np.ndarray) -> str:
        """Why a match is not believed; empty when it is."""
        correction = inverse(predicted) @ match.T_map_sensor
        moved = float(np.linalg.norm(correction[:3, 3]))
        turned = np.degrees(rotation_angle_rad(correction))
        if match.inlier_ratio < self._config.min_inlier_ratio:
            return f"only {match.inlier_ratio:.0%} of the scan lies on the scene's first visit"
        if match.residual_m > self._config.max_residual_m:
            return f"{match.residual_m:.2f} m off the scene's first visit"
        if moved > self._config.coarse_gate_m + self.reach_m or turned > MAX_TURN_DEG:
            return f"correction of {moved:.1f} m and {turned:.0f} deg is not believed"
        return ""

    def _reference(self, scene: Scene) -> Surface:
        if scene.scene_id not in self._references:
            self._references[scene.scene_id] = surface_of(self._load_reference(scene), self._config.voxel_m)
            if len(self._references) > CACHED_REFERENCES:
                self._references.popitem(last=False)
        self._references.move_to_end(scene.scene_id)
        return self._references[scene.scene_id]
