"""What each visit saw of a place: the same, a change, or nothing. Answered from the stored scans, on demand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..storage.rows import SceneScans
from ..storage.store import Store
from .config import DetectionConfig
from .detection.occlusion import sight
from .sensors import Sensors
from .submap_build import scan_view

STEPS = np.array([-0.5, 0.0, 0.5])  # of the radius: a place is asked at 27 points
MIN_SEEN_SHARE = 0.25  # of them; a visit that saw fewer says nothing


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
    samples = (place + radius_m * np.stack(np.meshgrid(STEPS, STEPS, STEPS), axis=-1).reshape(-1, 3)).astype(np.float32)
    history: list[PlaceSeen] = []
    for scans in _visits_near(store, map_id, place, limits.occlusion_range_m):
        history.append(_seen(store, sensors, scans, samples, limits, history))
    return history


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


def _seen(
    store: Store,
    sensors: Sensors,
    scene_and_scans: tuple[int, SceneScans],
    samples: np.ndarray,
    limits: DetectionConfig,
    before: list[PlaceSeen],
) -> PlaceSeen:
    scene, scans = scene_and_scans
    images = []
    for scan in store.scans.read_all(zip(scans.session.tolist(), scans.scan_id.tolist(), strict=True)):
        images.append(scan_view(scan, sensors.get(scan.sensor_digest), limits.occlusion_range_m)[2])
    seen = sight(samples, images, limits.occlusion_margin_m, limits.occlusion_range_m)
    occupied, free = float((seen.at > seen.through).mean()), float((seen.through > seen.at).mean())
    state = "not observed"
    if occupied + free >= MIN_SEEN_SHARE:
        state = "occupied" if occupied >= free else "free"
    known = [other.state for other in before if other.state != "not observed"]
    verdict = state if state == "not observed" else "first" if not known else _verdict(state, known[-1])
    return PlaceSeen(
        scene, int(scans.visit_number[0]), int(scans.session[0]), int(scans.stamp_ns[0]), int(scans.stamp_ns[-1]),
        len(images), occupied, free, state, verdict,
    )  # fmt: skip


def _verdict(state: str, last: str) -> str:
    return "same" if state == last else "changed"
