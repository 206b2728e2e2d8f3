"""One process of a simulation: casts a run of frames, writes their packets to a part of the pcap, reports each."""

import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..frame import Sensor
from ..metadata import sensor_from_metadata
from .packets import BOOT_NS, Encoder
from .pcap import Records
from .raycast import Caster, Hits
from .scenarios import Scenario
from .sensor import LIDAR_PORT, receive
from .truth import WITHIN_M
from .worlds import World, build_world


@dataclass(frozen=True)
class Job:
    """Frames first .. stop - 1 of a patrol, whose pcap records go to the file `part`."""

    scenario: Scenario
    seed: int
    metadata: str
    first: int
    stop: int
    part: Path


@dataclass(frozen=True, eq=False)
class Shot:
    """What the truth needs of one frame."""

    index: int
    stamp_ns: int  # sensor clock at the end of the frame
    T_world_sensor: np.ndarray  # (4, 4) there
    pass_index: int
    labels: np.ndarray  # (H, W) uint16: whose return each pixel is, 0 where it has none
    surface: np.ndarray  # (K, 4): object id and point met (world frame) of the returns of changing objects


def run(job: Job, world: World) -> Iterator[Shot]:
    """Writes the part, yielding a Shot after each frame. The same frames give the same bytes in whatever job."""
    records = None
    with open(job.part, "wb") as out:
        for shot, packets in frames(job, world):
            records = records or Records(packets[0].buf.size, LIDAR_PORT)
            host_ns = np.array([packet.host_timestamp for packet in packets], np.int64)
            out.write(records(np.stack([packet.buf for packet in packets]), host_ns, shot.index * len(packets)))
            yield shot


def frames(job: Job, world: World) -> Iterator[tuple[Shot, list]]:
    """-> (Shot, the LidarPackets) of each frame."""
    encoder, sensor = Encoder(job.metadata), sensor_from_metadata(job.metadata)
    watched = np.array(sorted({change.object_id for change in world.changes}), np.uint16)
    caster, cast_pass = None, None
    for index in range(job.first, job.stop):
        stamp = encoder.column_ns(index)
        t_s = (stamp - BOOT_NS) * 1e-9
        pass_index = world.patrol.pass_at(t_s[0])
        if pass_index != cast_pass:
            caster, cast_pass = Caster(world, pass_index), pass_index
        pose = world.patrol.pose(t_s)
        hits = caster.trace(sensor, pose, t_s)
        fields = receive(hits, sensor.pixel_shift, np.random.default_rng([job.seed, index]))
        packets = encoder.packets(encoder.frame(index, fields))
        surface = _surface(sensor, pose, hits, fields["object"], watched)
        yield Shot(index, int(stamp[-1]), pose[-1], pass_index, fields["object"], surface), packets


def _surface(sensor: Sensor, pose: np.ndarray, hits: Hits, labels: np.ndarray, watched: np.ndarray) -> np.ndarray:
    """(K, 4): object id and true point (world frame) of the returns of watched objects."""
    seen = np.isin(labels, watched) & (labels == hits.object_id) & (hits.range_m < WITHIN_M)
    row, column = np.nonzero(seen)
    local = sensor.direction[row, column].astype(float) * hits.range_m[row, column, None] + sensor.offset[row, column]
    point = np.einsum("kij,kj->ki", pose[column, :3, :3], local) + pose[column, :3, 3]
    return np.concatenate([labels[row, column, None], point], 1)


def main() -> None:
    """Job on stdin; Shots, then None or the exception that ended it, on stdout; all pickled."""
    answer = sys.stdout.buffer
    sys.stdout = sys.stderr  # nothing else may get between
    job = pickle.load(sys.stdin.buffer)

    def send(message) -> None:
        pickle.dump(message, answer, pickle.HIGHEST_PROTOCOL)
        answer.flush()

    try:
        for shot in run(job, build_world(job.scenario, job.seed)):
            send(shot)
        send(None)
    except Exception as error:
        send(error)
