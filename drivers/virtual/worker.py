"""One process of a simulation: casts a run of frames, writes their packets to a file, reports each."""

import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..metadata import sensor_from_metadata
from .packets import BOOT_NS, Encoder
from .pcap import Records
from .raycast import Caster
from .scenarios import Scenario
from .sensor import LIDAR_PORT, receive
from .witness import Witness
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
    surface: np.ndarray  # (K, 4): see Witness.surface
    looks: np.ndarray  # (K, 4): see Witness.looks


def run(job: Job, world: World) -> Iterator[Shot]:
    """Writes the part, yielding a Shot after each frame. Equal frames give equal bytes in whatever job."""
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
    current = None
    for index in range(job.first, job.stop):
        stamp = encoder.column_ns(index)
        t_s = (stamp - BOOT_NS) * 1e-9
        pass_index = world.patrol.pass_at(t_s[0])
        if pass_index != current:
            current = pass_index
            caster, witness = Caster(world, pass_index, with_vehicle=True), Witness(world, pass_index)
        pose = world.patrol.pose(t_s)
        hits = caster.trace(sensor, pose, t_s)
        fields = receive(hits, sensor.pixel_shift, np.random.default_rng([job.seed, index]))
        packets = encoder.packets(encoder.frame(index, fields))
        labels = fields["object"]
        surface, looks = (
            witness.surface(sensor, pose, hits, labels),
            witness.looks(sensor, pose, fields["RANGE"]),
        )
        yield Shot(index, int(stamp[-1]), pose[-1], pass_index, labels, surface, looks), packets


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
    except BrokenPipeError:
        sys.exit(1)  # nobody waits for the answer any more
    except Exception as error:
        send(error)
