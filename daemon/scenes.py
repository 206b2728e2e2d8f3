"""Scene identification (CDSD Algorithm 1) and the visits to each scene."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .config import SceneConfig
from .hull import convex_hull, distance_m, grown_area_m2

RETURN_REACH_M = 2.0  # a robot this near to where it was in the same visit ...
RETURN_PATH_M = 10.0  # ... so much of its path ago has come back: that is another visit
TURN_REACH_M = 1.5  # a robot stands and turns there: what changes meanwhile belongs to the new visit


@dataclass(eq=False)
class Scene:
    """A bounded region of the trajectory: a convex hull in the map's xy plane, grown by a margin."""

    scene_id: int
    hull: np.ndarray  # (M, 2) metres, map frame
    n_visits: int = 1


@dataclass(eq=False)
class Visit:
    """One stay in a scene, from entry to exit."""

    scene_id: int
    number: int  # v of the paper: 1 is the visit that made the scene
    t_in_ns: int
    t_out_ns: int
    scan_ids: list[int] = field(default_factory=list)
    path: list[np.ndarray] = field(default_factory=list)  # position (2,) of each scan, metres, map frame

    stamps_ns: list[int] = field(default_factory=list)

    def take(self, scan_id: int, stamp_ns: int, xy: np.ndarray) -> None:
        """One more key scan."""
        if not self.scan_ids or self.scan_ids[-1] != scan_id:
            self.scan_ids.append(scan_id)
            self.path.append(xy)
            self.stamps_ns.append(stamp_ns)
            self.t_out_ns = stamp_ns

    def returns_to(self, xy: np.ndarray) -> bool:
        """Whether a robot now at xy is back where it was earlier in this visit."""
        return self._turning_point(xy) is not None

    def split_off_return(self, xy: np.ndarray) -> Visit | None:
        """Give the scans since the robot turned back to a new visit; None where it did not come back."""
        turn = self._turning_point(xy)
        if turn is None:
            return None
        rest = Visit(self.scene_id, self.number + 1, self.stamps_ns[turn], self.t_out_ns)
        for name in ("scan_ids", "path", "stamps_ns"):
            setattr(rest, name, getattr(self, name)[turn:])
            setattr(self, name, getattr(self, name)[:turn])
        self.t_out_ns = self.stamps_ns[-1]
        return rest

    def _turning_point(self, xy: np.ndarray) -> int | None:
        """Index of the first scan of the turn: near the place farthest from xy since the robot was there before."""
        path = np.array([*self.path, xy])
        travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        away = np.linalg.norm(path - xy, axis=1)
        before = np.flatnonzero((travelled < travelled[-1] - RETURN_PATH_M) & (away < RETURN_REACH_M))
        if len(before) == 0:
            return None
        since = away[before[-1] :]
        return int(before[-1] + np.argmax(since > since.max() - TURN_REACH_M))


@dataclass(frozen=True, eq=False)
class SceneUpdate:
    """What one key scan did: a scene that came to be, and visits that ended."""

    new_scene: Scene | None
    ended_visits: list[Visit]


class SceneTracker:
    """Builds scenes while the robot explores, and notes visits to the scenes that stand.

    beta: the largest distance between two descriptors of a scene.

    Memory: one polygon for each scene of the map (some hundred bytes for 20 m of path), and the descriptors of
    the scene that is being built: those of this session, all by one model.
    """

    def __init__(self, config: SceneConfig, beta: float, scenes: list[Scene], next_scene_id: int):
        self._config = config
        self._beta = beta
        self._scenes = {scene.scene_id: scene for scene in scenes}
        self._next_scene_id = next_scene_id
        self._open_visits: dict[int, Visit] = {}
        self._clear_current()

    @property
    def open_visits(self) -> dict[int, Visit]:
        """Visits that go on, by scene id."""
        return self._open_visits

    def scenes_near(self, xy: np.ndarray, reach_m: float) -> list[Scene]:
        """Scenes whose grown hull lies within reach of a position (2,), nearest first."""
        reach = self._config.margin_m + reach_m
        distances = {scene.scene_id: distance_m(scene.hull, xy) for scene in self._scenes.values()}
        return [self._scenes[i] for i in sorted(distances, key=distances.get) if distances[i] <= reach]

    def update(self, scan_id: int, stamp_ns: int, xy: np.ndarray, descriptor: np.ndarray) -> SceneUpdate:
        """Take a key scan at xy (2,) metres in the map, descriptor (256,)."""
        new_scene = None
        if self._current is not None and self._is_over(self._current, stamp_ns, xy):
            new_scene = self._close_current()
        ended = self._end_visits(stamp_ns, xy)
        inside = self.scenes_near(xy, 0.0)
        self._stay_in(inside, scan_id, stamp_ns, xy)
        new_scene = self._grow_current(scan_id, stamp_ns, xy, descriptor, bool(inside)) or new_scene
        return SceneUpdate(new_scene, ended)

    def finish(self) -> SceneUpdate:
        """The session ends: close the scene being built and every open visit."""
        new_scene = self._close_current() if self._hull is not None else None
        ended = list(self._open_visits.values())
        self._open_visits = {}
        return SceneUpdate(new_scene, ended)

    # Algorithm 1 ------------------------------------------------------------------------------------------------

    def _grow_current(
        self, scan_id: int, stamp_ns: int, xy: np.ndarray, descriptor: np.ndarray, inside: bool
    ) -> Scene | None:
        if self._hull is None:
            if not inside:  # lines 4-5: no new scene while in an old one
                self._start_current(scan_id, stamp_ns, xy, descriptor)
            return None
        hull = convex_hull(np.vstack([self._hull, xy]))  # line 7
        too_large = grown_area_m2(hull, self._config.margin_m) > self._config.alpha_m2
        spread = np.linalg.norm(np.array(self._descriptors) - descriptor, axis=1).max()
        if not too_large and spread <= self._beta:  # line 8
            self._hull = hull  # line 17
            self._descriptors.append(descriptor)
            self._current.take(scan_id, stamp_ns, xy)
            return None
        scene = self._close_current()  # line 9
        if distance_m(scene.hull, xy) <= self._config.margin_m:  # lines 11-12
            self._stay_in([scene], scan_id, stamp_ns, xy)
        elif not inside:  # line 14
            self._start_current(scan_id, stamp_ns, xy, descriptor)
        return scene

    def _start_current(self, scan_id: int, stamp_ns: int, xy: np.ndarray, descriptor: np.ndarray) -> None:
        self._hull = convex_hull(xy)
        self._descriptors = [descriptor]
        self._current = Visit(self._next_scene_id, 1, stamp_ns, stamp_ns, [scan_id], [xy], [stamp_ns])
        self._next_scene_id += 1

    def _close_current(self) -> Scene:
        scene = Scene(self._current.scene_id, self._hull)
        self._scenes[scene.scene_id] = scene
        # The robot is still inside: the visit that made the scene goes on until it leaves.
        self._open_visits[scene.scene_id] = self._current
        self._clear_current()
        return scene

    def _clear_current(self) -> None:
        self._hull: np.ndarray | None = None
        self._descriptors: list[np.ndarray] = []
        self._current: Visit | None = None

    # Visits -----------------------------------------------------------------------------------------------------

    def _stay_in(self, inside: list[Scene], scan_id: int, stamp_ns: int, xy: np.ndarray) -> None:
        for scene in inside:
            if scene.scene_id not in self._open_visits:
                scene.n_visits += 1
                self._open_visits[scene.scene_id] = Visit(scene.scene_id, scene.n_visits, stamp_ns, stamp_ns)
        for visit in self._open_visits.values():
            visit.take(scan_id, stamp_ns, xy)

    def _end_visits(self, stamp_ns: int, xy: np.ndarray) -> list[Visit]:
        reach = self._config.margin_m + self._config.exit_margin_m
        over = [
            scene_id
            for scene_id, visit in self._open_visits.items()
            if distance_m(self._scenes[scene_id].hull, xy) > reach or self._is_over(visit, stamp_ns, xy)
        ]
        ended = [self._open_visits.pop(scene_id) for scene_id in over]
        for visit in ended:
            rest = visit.split_off_return(xy)
            if rest is not None:
                self._scenes[visit.scene_id].n_visits = rest.number
                self._open_visits[visit.scene_id] = rest
        return ended

    def _is_over(self, visit: Visit, stamp_ns: int, xy: np.ndarray) -> bool:
        """Visits that last, or in which the robot comes back on its path, are cut: results come while it is there."""
        return stamp_ns - visit.t_in_ns > self._config.max_visit_s * 1e9 or visit.returns_to(xy)
