"""What each visit saw of a place: the same, a change, or nothing. Answered from the stored scans, on demand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..drivers.frame import Sensor
from ..storage.rows import SceneScans
from ..storage.scans import Scan
from ..storage.store import Store
from .config import DetectionConfig
from .detection.occlusion import sight
from .detection.submap import Submap
from .sensors import Sensors
from .submap_build import build_submap

STEPS = np.array([-0.5, 0.0, 0.5])  # of the radius: a place is asked at 27 points
MIN_SEEN_SHARE = 0.25  # of them; a visit that saw fewer says nothing
CORE_SHARE = 2 / 3  # of the radius: what has returns from so near its middle is there, ...
CORE_RETURNS = 2  # ... so many in each of the scans that a thing must be seen by: a single one may be noise


@dataclass(frozen=True)
class PlaceSeen:
    """One visit and a place. Shares are of the place's sample points; what is in neither was not seen."""

    scene: int
    visit: int
    session: int
    first_ns: int  # sensor time of the first scan within range, in `session`
    last_ns: int
    n_scans: int  # within range
    share_occupied: float  # a return came from there
    share_free: float  # beams went through
    state: str  # "occupied", "free" or "not observed"
    verdict: str  # against the last visit that observed it: "first", "same" or "changed"; "not observed"


def place_history(
    store: Store, map_id: int, place: np.ndarray, radius_m: float, limits: DetectionConfig
) -> list[PlaceSeen]:
    """Every visit to the scenes around a place (3,) metres in a map, in order of time.

    Sight is that of the occlusion filter: limits gives its range and margin.
    """
    sensors = Sensors(store.dir)
    history: list[PlaceSeen] = []
    for scene, scans in _visits_near(store, map_id, place, limits.occlusion_range_m):
        views = _views(store, sensors, scans, limits.occlusion_range_m)
        occupied, free, state = look(views, place, radius_m, limits)
        history.append(
            PlaceSeen(
                scene,
                int(scans.visit_number[0]),
                int(scans.session[0]),
                int(scans.stamp_ns[0]),
                int(scans.stamp_ns[-1]),
                len(views.images),
                occupied,
                free,
                state,
                _verdict(state, history),
            )
        )
    return history


def look(views: Submap, place: np.ndarray, radius_m: float, limits: DetectionConfig) -> tuple[float, float, str]:
    """Shares of a place (3,) that the scans of a visit saw occupied and free, and the state that follows.

    A thin panel that is seen from its side fills little of the place, and beams pass it on either side: it is there
    all the same if there are returns from its very middle.
    """
    samples = (place + radius_m * np.stack(np.meshgrid(STEPS, STEPS, STEPS), axis=-1).reshape(-1, 3)).astype(np.float32)
    seen = sight(samples, views.images, limits.occlusion_margin_m, limits.occlusion_range_m)
    occupied, free = float((seen.at > seen.through).mean()), float((seen.through > seen.at).mean())
    in_core = ((views.points - place.astype(np.float32)) ** 2).sum(axis=1) < (CORE_SHARE * radius_m) ** 2
    meeting = np.bincount(views.scan[in_core], minlength=len(views.images)) >= CORE_RETURNS
    if meeting.sum() >= limits.min_showing_scans:
        return occupied, free, "occupied"
    if occupied + free < MIN_SEEN_SHARE:
        return occupied, free, "not observed"
    return occupied, free, "occupied" if occupied >= free else "free"


def _visits_near(store: Store, map_id: int, place: np.ndarray, range_m: float) -> list[tuple[int, SceneScans]]:
    """Each visit, with its scene and its scans within range of the place, in order of time."""
    visits = []
    for scene in store.index.scenes(map_id):
        scans = store.index.scans_of_scene(scene.scene_id)
        near = np.linalg.norm(scans.T_map_sensor[:, :3, 3] - place, axis=1) < range_m
        near &= (scans.visit_number == 1) | scans.aligned
        for number in np.unique(scans.visit_number[near]):
            visits.append((scene.scene_id, scans.only(near & (scans.visit_number == number))))
    visits.sort(key=lambda visit: int(visit[1].scan_id[0]))
    return visits


def _views(store: Store, sensors: Sensors, scans: SceneScans, range_m: float) -> Submap:
    def read(i: int) -> tuple[Scan, Sensor]:
        scan = store.scans.read(int(scans.session[i]), int(scans.scan_id[i]))
        return scan, sensors.get(scan.sensor_digest)

    return build_submap(read, scans.visit_number, range_m)[0]


def _verdict(state: str, before: list[PlaceSeen]) -> str:
    known = [other.state for other in before if other.state != "not observed"]
    if state == "not observed":
        return state
    if not known:
        return "first"
    return "same" if state == known[-1] else "changed"
