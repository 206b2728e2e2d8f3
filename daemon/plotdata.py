"""What a picture of the stored results shows, gathered from the data directory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..storage.changerows import ChangeObject
from ..storage.errors import DataDirError
from ..storage.rows import SceneRow, SessionRow, Trajectory
from ..storage.store import Store
from .sensors import Sensors
from .views import map_points

MAP_SCANS = 80  # evenly over the trajectory
MAP_RANGE_M = 40.0
MAP_STRIDE = 3  # every third return is enough for a picture
CLOSE_UP_SCANS = 5  # the nearest ones, before and after
CLOSE_UP_RANGE_M = 25.0


@dataclass(frozen=True, eq=False)
class MapPicture:
    """One map with all that is known of it. Metres, map frame."""

    map_id: int
    n_maps: int  # in the data directory
    sessions: list[SessionRow]
    sensor: str  # product and serial number
    trajectory: Trajectory
    visit_number: np.ndarray  # (N,) int64, of each scan of the trajectory: how often the robot has been there
    scenes: list[SceneRow]
    changes: list[ChangeObject]
    points: np.ndarray  # (P, 3) float32


@dataclass(frozen=True, eq=False)
class CloseUp:
    """The surroundings of a change as the scans before and after it show them. Metres, map frame."""

    change: ChangeObject
    before: np.ndarray  # (B, 3) float32
    after: np.ndarray  # (A, 3) float32
    eye: np.ndarray  # (3,) where the robot looked from


def gather(data_dir: Path, n_close_ups: int) -> tuple[MapPicture, list[CloseUp]]:
    """The map with the most scans, and its largest changes from near. Raises DataDirError without any scan."""
    with Store.open_reader(data_dir) as store:
        sensors = Sensors(store.dir)
        picture = _map_picture(store, sensors)
        largest = sorted(picture.changes, key=lambda change: (-change.n_points, change.id))[:n_close_ups]
        return picture, [_close_up(store, sensors, change) for change in sorted(largest, key=lambda c: c.id)]


def _map_picture(store: Store, sensors: Sensors) -> MapPicture:
    trajectory = store.index.trajectory()
    if len(trajectory.scan_id) == 0:
        raise DataDirError(f"{store.dir.path}: holds no key scan yet: nothing to draw")
    map_of = {session.session_id: session.map_id for session in store.index.sessions()}
    maps, counts = np.unique([map_of[session] for session in trajectory.session.tolist()], return_counts=True)
    map_id = int(maps[counts.argmax()])
    sessions = [session for session in store.index.sessions() if session.map_id == map_id]
    trajectory = trajectory.only(np.isin(trajectory.session, [session.session_id for session in sessions]))
    numbers = store.index.latest_visit_numbers()
    sensor = sensors.get(sessions[0].sensor_digest)
    return MapPicture(
        map_id,
        len(maps),
        sessions,
        f"{sensor.product} {sensor.serial}".strip(),
        trajectory,
        np.array([numbers.get(scan_id, 1) for scan_id in trajectory.scan_id.tolist()]),
        store.index.scenes(map_id),
        store.changes.changes(map_id=map_id),
        _points(store, sensors, _evenly(trajectory, MAP_SCANS), MAP_RANGE_M, MAP_STRIDE),
    )


def _close_up(store: Store, sensors: Sensors, change: ChangeObject) -> CloseUp:
    clouds = []
    for scans in (
        store.index.scans_of_scene(change.scene, before_visit=change.visit),
        store.index.scans_of_scene(change.scene, visit=change.visit),
    ):
        distance = np.linalg.norm(scans.T_map_sensor[:, :3, 3] - change.centroid, axis=1)
        near = scans.only(np.sort(np.argsort(distance, kind="stable")[:CLOSE_UP_SCANS]))
        clouds.append(_points(store, sensors, near, CLOSE_UP_RANGE_M, 1))
    eye = near.T_map_sensor[:, :3, 3].mean(axis=0) if len(near.scan_id) else change.centroid - [1.0, 0.0, 0.0]
    return CloseUp(change, *clouds, eye)


def _evenly(scans: Trajectory, n: int) -> Trajectory:
    return scans.only(np.unique(np.linspace(0, len(scans.scan_id) - 1, n).round().astype(int)))


def _points(store: Store, sensors: Sensors, scans: Trajectory, range_m: float, stride: int) -> np.ndarray:
    """Every stride-th return within range of these scans: (N, 3) float32."""
    clouds = [np.empty((0, 3), np.float32)]
    for session, scan_id in zip(scans.session.tolist(), scans.scan_id.tolist(), strict=True):
        scan = store.scans.read(session, scan_id)
        clouds.append(map_points(scan, sensors.get(scan.sensor_digest), range_m)[::stride].copy())
    return np.concatenate(clouds)
