"""One session: a run of the odometry without a break, in one map, and what it knows of the map."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from .. import __version__
from ..drivers.frame import Sensor
from ..storage.store import Store
from .config import AlignmentConfig, Config, dump_config
from .hull import grown_area_m2
from .joining import Join
from .keyscans import KeyScanRule
from .localization import Localizer
from .odometry import Odometry
from .references import reference_cells
from .scenes import Scene, SceneTracker, SceneUpdate
from .sensors import Sensors
from .voxels import Moments
from .worker import Instance


class Session:
    """The parts that begin anew when the odometry does, or when its place in an earlier map is found."""

    def __init__(
        self,
        config: Config,
        store: Store,
        sensors: Sensors,
        sensor: Sensor,
        source: str,
        beta: float,
        join: Join | None = None,
        continues: Session | None = None,
    ):
        """A session with a map of its own; with a join, the one that continues another in an earlier map.

        beta: the largest distance between two descriptors of a scene.
        """
        self._config = config
        self._store = store
        self._sensors = sensors
        self._sensor = sensor
        self._source = source
        self._beta = beta
        sensors.put(sensor)
        self.session_id = store.index.start_session(
            source=source,
            sensor_digest=sensor.digest,
            serial=sensor.serial,
            product=sensor.product,
            firmware=sensor.firmware,
            profile=sensor.profile,
            clock_source=sensor.timestamp_mode,
            config=dump_config(config),
            software_version=__version__,
            map_id=join.map_id if join else None,
            continues=continues.session_id if continues else None,
        )
        self.map_id = join.map_id if join else self.session_id
        self.odometry = continues.odometry if continues else Odometry(config.odometry)
        self.key_scans = continues.key_scans if continues else KeyScanRule(config.keyscans)
        T_map_odom = join.T_map_odom if join else np.eye(4)
        self.localizer = Localizer(
            # Not a method of ours: session and localizer would hold each other, and 40 MB of maps with them.
            config.alignment,
            partial(_reference, store, sensors, config.alignment),
            T_map_odom,
        )
        known = [Scene(row.scene_id, row.hull, row.n_visits) for row in store.index.scenes(self.map_id)]
        self._unrecorded: list[SceneUpdate] = []  # what the disk has not taken yet
        self.scenes = SceneTracker(config.scenes, beta, known, store.index.next_scene_id())

    def joined(self, join: Join) -> Session:
        """The session that goes on from this one, which has ended, in an earlier map: the same odometry, no break."""
        return Session(self._config, self._store, self._sensors, self._sensor, self._source, self._beta, join, self)

    def scenes_to_align_with(self, T_odom_sensor: np.ndarray, ahead_m: float = 0.0) -> list[Scene]:
        """Known scenes that the robot may be in, or come to within ahead_m, nearest first; not those in the making."""
        xy = self.localizer.predict(T_odom_sensor)[:2, 3]
        being_made = {visit.scene_id for visit in self.scenes.open_visits.values() if visit.number == 1}
        near = self.scenes.scenes_near(xy, self.localizer.reach_m + ahead_m)
        return [scene for scene in near if scene.scene_id not in being_made]

    def record(self, update: SceneUpdate) -> list[Instance]:
        """Store what a key scan did to the scenes; the instances that are due: each visit but a scene's first.

        Raises StorageUnavailable; what could not be stored is stored with the next one.
        """
        if update.new_scene is not None or update.ended_visits:
            self._unrecorded.append(update)
        if not self._unrecorded:
            return []
        with self._store.index.transaction():
            due = [instance for waiting in self._unrecorded for instance in self._record(waiting)]
        self._unrecorded.clear()
        return due

    def _record(self, update: SceneUpdate) -> list[Instance]:
        index, due = self._store.index, []
        if update.new_scene is not None:
            hull, margin = update.new_scene.hull, self._config.scenes.margin_m
            index.add_scene(update.new_scene.scene_id, self.map_id, hull, margin, grown_area_m2(hull, margin))
        for visit in update.ended_visits:
            visit_id = index.open_visit(visit.scene_id, visit.number, self.session_id, visit.t_in_ns)
            index.add_visit_scans(visit_id, visit.scan_ids)
            index.close_visit(visit_id, visit.t_out_ns)
            if visit.number >= 2:
                due.append(
                    Instance(
                        self.session_id,
                        self.map_id,
                        visit.scene_id,
                        visit_id,
                        visit.number,
                        visit.t_in_ns,
                        visit.t_out_ns,
                    )
                )
        return due


def _reference(store: Store, sensors: Sensors, config: AlignmentConfig, scene: Scene) -> Iterator[Moments]:
    """The cells of a scene's first visit, one scan after another, in the map."""
    first_visit = store.index.scans_of_scene(scene.scene_id, visit=1)
    return reference_cells(first_visit, store.scans, sensors, config)
