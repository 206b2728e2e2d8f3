"""Locates and compares the key scans of a stored patrol again, without its packets and KISS-ICP: minutes, not a replay.

    python tests/benchmarks/relocate.py /tmp/patrols/long12_64_RNG15 [...] [--into /tmp/again]

Takes patrols as tests/benchmarks/patrols.py leaves them. Each one's key scans go through the pipeline with the
odometry's poses that are stored with them, into a data directory of their own; prints what patrols.py prints of it:
what was found, and the error of the poses.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
from rerun import InProcess
from scoring import score

from revisitd.daemon.config import Config
from revisitd.daemon.instances import ChangeDetection
from revisitd.daemon.odometry import Health, Motion
from revisitd.daemon.pipeline import Pipeline
from revisitd.daemon.sensors import Sensors
from revisitd.daemon.worker import DetectionWorker
from revisitd.drivers.frame import Frame
from revisitd.models.descriptor import DescriptorModel
from revisitd.storage.scans import Scan, ScanStore
from revisitd.storage.store import Store


def scans_of(data: Path) -> Iterator[Scan]:
    """The key scans of a data directory, in the order in which they were taken."""
    for path in sorted((data / "scans").glob("*/*/*.scan"), key=lambda path: int(path.stem)):
        yield ScanStore(data / "scans").read(int(path.parts[-3]), int(path.stem))


class StoredOdometry:
    """The odometry's answers of the day."""

    def __init__(self, motions: dict[int, Motion]):
        self._motions = motions

    def register(self, frame: Frame) -> Motion:
        """The motion of a stored frame."""
        return self._motions[frame.stamp_ns]


def relocate(source: Path, into: Path, config: Config) -> np.ndarray:
    """Put all key scans of one data directory into another, located and compared anew; CPU seconds of each of them."""
    shutil.rmtree(into, ignore_errors=True)
    seconds = []
    with Store.open_writer(into) as store:
        shutil.copytree(source / "sensors", into / "sensors", dirs_exist_ok=True)
        sensors, model, motions = Sensors(store.dir), DescriptorModel.load(), {}
        detection = ChangeDetection(config, store, InProcess(into), model)
        worker = DetectionWorker(detection.run, config.worker.queue_size)
        with mock.patch("revisitd.daemon.session.Odometry", lambda _: StoredOdometry(motions)):
            pipeline = Pipeline(config, store, sensors, model, worker, lambda _: None, str(source), wait=True)
            for scan in scans_of(source):
                motions[scan.stamp_ns] = Motion(scan.T_odom_sensor, scan.T_start_end, Health.GOOD)
                frame = Frame(
                    sensors.get(scan.sensor_digest), scan.frame_id, scan.range_mm, scan.reflectivity,
                    scan.column_ns, scan.column_valid, scan.host_ns,
                )  # fmt: skip
                begun = time.thread_time()
                pipeline.process(frame)
                seconds.append(time.thread_time() - begun)
            pipeline.finish()
            worker.drain()
            worker.close()
    return np.array(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("patrols", type=Path, nargs="+")
    parser.add_argument("--into", type=Path, default=Path("/tmp/again"))
    arguments = parser.parse_args()
    for patrol in arguments.patrols:
        into = arguments.into / patrol.name
        each_s = relocate(patrol / "data", into, Config())
        result = score(into, patrol / "truth")
        print(
            f"{patrol.name}: found {result.n_found}/{len(result.kinds)}, "
            f"whole {sum(share > 0.75 for share in result.by_surface)} by surface, "
            f"{sum(share > 0.75 for share in result.by_points)} by points; "
            f"false {result.small} small {result.large} large, duplicates {result.duplicates}; "
            f"trajectory rms {result.rms_m:.3f} max {result.max_m:.3f} m; "
            f"{1e3 * each_s.mean():.0f} ms of CPU a key scan, at most {1e3 * each_s.max():.0f}",
            flush=True,
        )
        for kind, by_surface, by_points in zip(result.kinds, result.by_surface, result.by_points, strict=True):
            if by_surface < 0.9:
                print(f"    {kind}: {by_surface:.0%} of its surface, {by_points:.0%} of its points")
        for change in result.false:
            print(f"    false: {change.polarity} at {change.centroid.round(1)}, {change.n_points} points")


if __name__ == "__main__":
    main()
