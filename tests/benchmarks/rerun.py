"""Runs the change detection of a stored patrol again, in this process, with other settings or other parts."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

from revisitd.daemon.comparer import Comparer
from revisitd.daemon.comparison import Comparison, Job
from revisitd.daemon.config import Config
from revisitd.daemon.instances import ChangeDetection
from revisitd.daemon.scenes import SceneTracker
from revisitd.daemon.session import Session
from revisitd.daemon.worker import Instance
from revisitd.models.descriptor import DescriptorModel
from revisitd.storage.store import Store

VISITS = """
    SELECT v.session_id, s.map_id, v.scene_id, v.visit_id, v.number, v.t_in_ns, v.t_out_ns
    FROM visits v JOIN scenes s USING (scene_id) WHERE v.number >= 2 ORDER BY v.visit_id"""


class InProcess:
    """A DetectionProcess without a process."""

    def __init__(self, data: Path):
        self._comparer = Comparer(data)

    def compare(self, job: Job) -> Comparison:
        """Runs the job."""
        return self._comparer.compare(job)

    def close(self) -> None:
        """Nothing to end."""


def copy_without_changes(source: Path, into: Path) -> None:
    """A data directory of the same scans, scenes and visits, that was never searched for changes."""
    shutil.rmtree(into, ignore_errors=True)
    into.mkdir(parents=True)
    for name in ("revisitd.json", "index.db"):
        shutil.copy(source / name, into / name)
    for name in ("scans", "sensors"):
        (into / name).symlink_to((source / name).resolve())
    with sqlite3.connect(into / "index.db") as db:
        db.execute("DELETE FROM instances")


def find_scenes_again(data: Path, config: Config) -> None:
    """Forget the scenes, and find them with other settings on the same key scans."""
    with sqlite3.connect(data / "index.db") as db:
        for table in ("visit_scans", "visits", "scenes"):
            db.execute(f"DELETE FROM {table}")
    with Store.open_writer(data) as store:
        path = store.index.trajectory()
        model = model_of(store)
        _, descriptors = store.index.all_descriptors(model.model_id)
        beta = float(model.distance_from_overlap(config.scenes.min_overlap))
        tracker = SceneTracker(config.scenes, beta, [], store.index.next_scene_id())
        session = _recorder(store, config)
        for i in range(len(path.scan_id)):
            xy = path.T_map_sensor[i, :2, 3]
            update = tracker.update(int(path.scan_id[i]), int(path.stamp_ns[i]), xy, descriptors[i])
            session.record(update)
        session.record(tracker.finish())


def _recorder(store: Store, config: Config) -> Session:
    """A session that only records."""
    session = Session.__new__(Session)
    session._store, session._config, session.session_id, session.map_id, session._unrecorded = store, config, 1, 1, []
    return session


def instances_of(store: Store) -> list[Instance]:
    """Every visit but the scenes' first ones, in the order in which they ended."""
    return [Instance(*row) for row in store.index.db.tuples(VISITS)]


def model_of(store: Store) -> DescriptorModel:
    """The model, which must be the one that described the scans: the calibration of no other fits their distances."""
    model, described_by = DescriptorModel.load(), store.index.db.value("SELECT model_id FROM descriptors LIMIT 1")
    if described_by != model.model_id:
        raise SystemExit(f"{store.dir.path} was described by model {described_by}, this is {model.model_id}: replay it")
    return model


def detection_on(store: Store, config: Config) -> ChangeDetection:
    """The change detection of an open store, in this process."""
    return ChangeDetection(config, store, InProcess(store.dir.path), model_of(store))


def detect_again(data: Path, config: Config) -> list[tuple[float, int]]:
    """Run every instance; seconds of each that was compared, and when its visit ended, ns."""
    with Store.open_writer(data) as store:
        detection, instances = detection_on(store, config), instances_of(store)
        for instance in instances:
            detection.run(instance)
        done = dict(store.index.db.tuples("SELECT visit_id, seconds FROM instances WHERE status = 'done'"))
    return [(done[i.visit_id], i.t_out_ns) for i in instances if i.visit_id in done]
