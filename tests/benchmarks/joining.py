"""How surely a session is joined to the map of an earlier one, and how surely not to the map of another place.

    python tests/benchmarks/joining.py /tmp/patrols/* --step 4

Takes patrols as tests/benchmarks/patrols.py leaves them. The map is what each one's first lap made. Key scans of its
later laps, turned by random headings, are looked for in it, and in those of the other worlds; a session would be joined
where two of them, five metres apart, agree. Errors are against the true poses, so they hold the map's own.
"""

from __future__ import annotations

import argparse
import shutil
import sqlite3
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from revisitd.daemon.config import Config
from revisitd.daemon.geometry import inverse, rotation_angle_rad, transform
from revisitd.daemon.joining import AGREE_DEG, AGREE_M, EVERY_M
from revisitd.daemon.relocalization import Answer, Relocator, same_pose
from revisitd.daemon.sensors import Sensors
from revisitd.daemon.views import sensor_points
from revisitd.storage.store import Store

RIGHT_M, RIGHT_DEG = 0.5, 2.0


class Query:
    """A key scan of a later lap, turned: points (N, 3) in the sensor's frame, true T_map_sensor (4, 4)."""

    def __init__(self, scan, sensor, T_map_sensor: np.ndarray, yaw: float):
        T_scan_turned = np.eye(4)
        T_scan_turned[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
        self.points = transform(inverse(T_scan_turned), sensor_points(scan, sensor, Config().alignment.range_m))
        self.T_map_sensor = T_map_sensor @ T_scan_turned
        self.descriptor, self.model_id = scan.descriptor, scan.model_id


def queries(folder: Path, data: Path, step: int) -> list[tuple[Query, Query]]:
    """Pairs of key scans of the later laps, EVERY_M apart, from every step-th on."""
    rows, rng = np.loadtxt(folder / "truth" / "poses.txt"), np.random.default_rng(0)
    with Store.open_reader(data) as store:
        path, visit = store.index.trajectory(), store.index.latest_visit_numbers()
        sensors = Sensors(store.dir)
        later = [k for k, scan_id in enumerate(path.scan_id.tolist()) if visit.get(scan_id, 1) >= 2]
        travelled = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(path.T_map_sensor[:, :3, 3], axis=0), axis=1))]
        )

        def query(k: int, yaw: float) -> Query:
            scan = store.scans.read(int(path.session[k]), int(path.scan_id[k]))
            row = rows[np.abs(rows[:, 0] - scan.stamp_ns * 1e-9).argmin()]
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = Rotation.from_quat(row[4:8]).as_matrix(), row[1:4]
            return Query(scan, sensors.get(scan.sensor_digest), T, yaw)

        pairs = []
        for k in later[::step]:
            ahead = np.flatnonzero(travelled >= travelled[k] + EVERY_M)
            if len(ahead):
                yaw = rng.uniform(0, 2 * np.pi)
                pairs.append((query(k, yaw), query(int(ahead[0]), yaw)))
        return pairs


def copied(folder: Path, scratch: Path) -> Path:
    """A patrol's data, of this version's schema, to be altered."""
    copy = scratch / folder.name
    shutil.copytree(folder / "data", copy, ignore=shutil.ignore_patterns("scans"))
    (copy / "scans").symlink_to((folder / "data" / "scans").resolve())
    Store.open_writer(copy).close()
    return copy


def first_lap(data: Path) -> Relocator:
    """Looks in what was known after the first lap."""
    with sqlite3.connect(data / "index.db") as db:
        db.execute("DELETE FROM visit_scans WHERE visit_id IN (SELECT visit_id FROM visits WHERE number > 1)")
        db.execute("DELETE FROM visits WHERE number > 1")
    return Relocator(data, Config().alignment)


def agree(pair: tuple[Query, Query], answers: list[Answer]) -> bool:
    """Whether both answers are believed and the way between them is the true one."""
    way = inverse(pair[0].T_map_sensor) @ pair[1].T_map_sensor
    expected = answers[0].T_map_sensor @ way
    believed = not any(answer.reason for answer in answers)
    return believed and same_pose(expected, answers[1].T_map_sensor, AGREE_M, AGREE_DEG)


def attempts(relocator: Relocator, pairs: list[tuple[Query, Query]]) -> tuple[list[tuple[Query, Answer]], int]:
    """Each query with its answer, and how many pairs would join a session."""
    answered, joins = [], 0
    for pair in pairs:
        answers = [relocator.find(query.points, query.descriptor, query.model_id, [1]) for query in pair]
        answered += zip(pair, answers, strict=True)
        joins += agree(pair, answers)
    return answered, joins


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("patrols", type=Path, nargs="+")
    parser.add_argument("--step", type=int, default=4, help="every so many-th key scan is a start")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        data = {folder: copied(folder, Path(scratch)) for folder in arguments.patrols}
        pairs = {folder: queries(folder, data[folder], arguments.step) for folder in arguments.patrols}
        maps = {folder: first_lap(data[folder]) for folder in arguments.patrols}
        for folder, relocator in maps.items():
            answered, joins = attempts(relocator, pairs[folder])
            believed = [(query, answer) for query, answer in answered if not answer.reason]
            errors = [inverse(query.T_map_sensor) @ answer.T_map_sensor for query, answer in believed]
            metres = np.array([np.linalg.norm(T[:3, 3]) for T in errors])
            degrees = np.array([np.degrees(rotation_angle_rad(T)) for T in errors])
            wrong = int(((metres > RIGHT_M) | (degrees > RIGHT_DEG)).sum())
            line = (
                f"{folder.name}: {joins} of {len(pairs[folder])} starts join; {len(believed)} of {len(answered)} scans "
                f"found, {wrong} wrong; error median {np.median(metres):.3f} max {metres.max():.3f} m, "
                f"median {np.median(degrees):.2f} max {degrees.max():.2f} deg"
            )
            world = folder.name.split("_")[0]
            others = [other for other in pairs if other.name.split("_")[0] != world]
            strangers = [attempts(relocator, pairs[other][::3]) for other in others]
            n = sum(len(answered) for answered, _ in strangers)
            false = sum(not answer.reason for answered, _ in strangers for _, answer in answered)
            print(
                f"{line}; {false} of {n} scans of other worlds found in it, {sum(j for _, j in strangers)} joins",
                flush=True,
            )


if __name__ == "__main__":
    main()
