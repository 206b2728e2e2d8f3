"""UDP payloads -> rotations of one sensor: which packets are its own, and their assembly into Frames."""

import copy
from collections import Counter
from collections.abc import Iterator

import numpy as np
from ouster.sdk import core

from .frame import Frame, Sensor
from .losses import Loss

FIELDS = ("RANGE", "REFLECTIVITY")
COLUMN_ID_OFFSET = 8  # of the measurement id in a column's header, in all profiles
CHECKSUM_TRIAL_PACKETS = 64  # firmware before 2.5 fills in something else: checksums count once one is right
RESTART_PACKETS = 8  # so many in a row that are too old: not late ones, but frame ids that begin again


class PacketFilter:
    """Says of each datagram whether it is a lidar packet of this sensor, or why not."""

    def __init__(self, info: core.SensorInfo):
        self.format = core.PacketFormat.from_info(info)
        self.size = self.format.lidar_packet_size
        self.port = info.config.udp_port_lidar or None  # None: the metadata does not tell
        self.has_ids = info.format.udp_profile_lidar != core.UDPProfileLidar.LEGACY
        self.profile = str(info.format.udp_profile_lidar)
        self.beams = info.format.pixels_per_column
        self.columns = info.format.columns_per_frame
        self.expected_ids = (info.sn, info.init_id)
        self._column_at = self.format.packet_header_size + COLUMN_ID_OFFSET
        self._by_port = {info.config.udp_port_imu: Loss.IMU_PACKET, info.config.udp_port_zm: Loss.ZONE_PACKET}
        self._by_size = {
            self.format.imu_packet_size: Loss.IMU_PACKET,
            self.format.zone_packet_size: Loss.ZONE_PACKET,
        }

    def fault(self, payload: bytes | np.ndarray, port: int) -> Loss | None:
        """payload, and the UDP port it was sent to -> why it is of no use, or None."""
        if self.port and port != self.port:
            return self._by_port.get(port, Loss.OTHER_PORT)
        if len(payload) != self.size:
            return self._by_size.get(len(payload), Loss.WRONG_SIZE)
        if self.has_ids and (ids := self.ids(payload)) != self.expected_ids:
            return Loss.OTHER_INIT_ID if ids[0] == self.expected_ids[0] else Loss.OTHER_SENSOR
        column = int.from_bytes(payload[self._column_at : self._column_at + 2], "little")
        return Loss.WRONG_COLUMN if column >= self.columns else None

    def ids(self, payload: bytes | np.ndarray) -> tuple[int, int]:
        """payload of `size` bytes -> serial, init id; both 0 in the LEGACY profile."""
        return self.format.prod_sn(payload), self.format.init_id(payload)


class FrameAssembler:
    """Puts lidar packets together into the SDK's frames; takes the packets that PacketFilter let pass."""

    def __init__(self, info: core.SensorInfo, losses: Counter, fields: tuple[str, ...] = FIELDS):
        # The batcher would hold each frame back until its IMU packets have come, and nobody feeds it those.
        self._info = copy.deepcopy(info)
        self._info.format.udp_profile_imu = core.UDPProfileIMU.LEGACY
        self._format = core.PacketFormat.from_info(self._info)
        self._field_types = [kind for kind in core.get_field_types(self._info) if kind.name in fields]
        self._losses = losses
        self._newest_id: int | None = None
        self._too_old: list[core.LidarPacket] = []
        self._checksum_seen = False
        self._checksum_trials = 0
        self._begin()

    def packet(self, payload: bytes, host_ns: int) -> core.LidarPacket:
        """The payload of a datagram that was received at host_ns, for add()."""
        packet = core.LidarPacket(self._format)
        packet.buf[:] = np.frombuffer(payload, np.uint8)
        packet.host_timestamp = max(host_ns, 1)  # at 0 the batcher completes no frame before the next begins
        return packet

    def add(self, packet: core.LidarPacket) -> Iterator[core.LidarFrame]:
        """Takes one packet and yields each frame that it completes."""
        if self._is_corrupt(packet):
            self._losses[Loss.BAD_CHECKSUM] += 1
        elif not self._is_too_old(packet.frame_id()):
            self._too_old.clear()
            yield from self._batch(packet)
        elif len(self._too_old) + 1 < RESTART_PACKETS:
            self._too_old.append(packet)
            yield from self._batch(packet)
        else:
            yield from self._restart([*self._too_old, packet])

    def flush(self) -> Iterator[core.LidarFrame]:
        """Yields what there is of the last frame."""
        self._count_late()
        if self._batcher.batched_packets():
            yield self._frame
        self._begin()

    def _begin(self) -> None:
        self._batcher = core.FrameBatcher(self._info)
        self._frame = core.LidarFrame(self._info, self._field_types)
        self._late = 0

    def _batch(self, packet: core.LidarPacket) -> Iterator[core.LidarFrame]:
        try:
            complete = self._batcher.batch(packet, self._frame)
        except RuntimeError:  # what the SDK does with a late packet where frame ids have 32 bits
            self._losses[Loss.LATE_PACKET] += 1
            return
        if complete:
            self._count_late()
            yield self._frame
            self._frame = core.LidarFrame(self._info, self._field_types)

    def _is_too_old(self, frame_id: int) -> bool:
        """Whether the id lies before the newest one; ids count round."""
        ids = self._format.max_frame_id + 1
        if self._newest_id is None or (frame_id - self._newest_id) % ids < ids // 2:
            self._newest_id = frame_id
            return False
        return True

    def _restart(self, packets: list[core.LidarPacket]) -> Iterator[core.LidarFrame]:
        """Begins anew with packets that looked too old: the batcher would drop them until ids catch up."""
        self._losses[Loss.RESTARTED] += 1
        self._late = max(self._late, self._batcher.dropped_packets())  # those dropped are used below
        yield from self.flush()
        self._too_old = []
        self._newest_id = packets[-1].frame_id()
        for packet in packets:
            yield from self._batch(packet)

    def _count_late(self) -> None:
        late = self._batcher.dropped_packets()
        if late > self._late:
            self._losses[Loss.LATE_PACKET] += late - self._late
        self._late = late

    def _is_corrupt(self, packet: core.LidarPacket) -> bool:
        if not self._checksum_seen and self._checksum_trials >= CHECKSUM_TRIAL_PACKETS:
            return False
        checksum = packet.crc()
        if checksum is None:
            return False
        right = checksum == packet.calculate_crc()
        self._checksum_seen |= right
        self._checksum_trials += 1
        return self._checksum_seen and not right


def packets_per_frame(info: core.SensorInfo) -> int:
    """Packets that a rotation is sent in: those that touch the column window."""
    first, last = info.format.column_window
    columns = info.format.columns_per_frame
    in_window = np.arange(first, last + 1 if first <= last else last + 1 + columns) % columns
    return len(np.unique(in_window // info.format.columns_per_packet))


def frame_from_sdk(lidar_frame: core.LidarFrame, sensor: Sensor) -> Frame | None:
    """The SDK's frame of this sensor -> ours, sharing its arrays; None where no column is valid."""
    valid = (lidar_frame.status & 1).astype(bool)
    if not valid.any():
        return None
    range_mm = lidar_frame.field("RANGE").astype(np.uint32, copy=False)
    if lidar_frame.has_field("REFLECTIVITY"):
        reflectivity = np.minimum(lidar_frame.field("REFLECTIVITY"), 255).astype(np.uint8, copy=False)
    else:
        reflectivity = np.zeros(sensor.shape, np.uint8)
    if not valid.all():  # a column that was sent but marked as bad has ranges all the same
        range_mm[:, ~valid] = 0
        reflectivity[:, ~valid] = 0
    return Frame(
        sensor=sensor,
        frame_id=int(lidar_frame.frame_id),
        range_mm=range_mm,
        reflectivity=reflectivity,
        column_ns=np.where(valid, lidar_frame.timestamp.astype(np.int64), 0),
        column_valid=valid,
        host_ns=int(lidar_frame.packet_timestamp.max()),
    )
