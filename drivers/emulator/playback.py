"""Gives a capture's packets times, frame ids and a sender that go on: over its end, restarts and clock steps."""

import numpy as np
from ouster.sdk import core

from ..packets import COLUMN_ID_OFFSET

LONGEST_PAUSE_NS = 10_000_000_000  # in a capture; what lies farther ahead follows at once
ID_BYTES, SERIAL_BYTES = 3, 5
PLACES = {0xFFFF: (4, 7), 0xFFFFFFFF: (1, 11)}  # largest frame id -> where init id and serial are in a packet
CRC_BYTES = 8
IMU_TIMES = 3  # system, accelerometer, gyroscope: the first 24 bytes of a LEGACY IMU packet


class Timeline:
    """Joins passes of a capture: what time is played, from 0, and which frame ids."""

    def __init__(self, period_ns: int):
        self._period_ns = period_ns
        self._start_ns = -period_ns  # played time at which the last rotation began
        self._shift_ns: int | None = None
        self._id_shift: int | None = None
        self._next_id = 0
        self.played_ns = 0  # up to the last packet

    @property
    def shift_ns(self) -> int | None:
        """From the capture's clock to played time; None before the first lidar packet."""
        return self._shift_ns

    def join(self) -> None:
        """What comes next is the rotation after that which was played last, whatever its time and id."""
        self._shift_ns = self._id_shift = None

    def restart_ids(self) -> None:
        """Frame ids begin again with the next packet."""
        self._next_id, self._id_shift = 0, None

    def place(self, start_ns: int, last_ns: int, frame_id: int, max_id: int) -> tuple[int, int]:
        """A lidar packet of the capture: when its rotation began, its last column, its frame id.

        Returns the shift of its times, and its frame id as played.
        """
        if self._shift_ns is not None:
            ahead_ns = start_ns + self._shift_ns - self._start_ns
            if not -self._period_ns // 2 < ahead_ns < LONGEST_PAUSE_NS:  # packets out of order lie nearer
                self.join()
        if self._shift_ns is None:
            self._shift_ns = self._start_ns + self._period_ns - start_ns
        if self._id_shift is None:
            self._id_shift = self._next_id - frame_id
        played_id = (frame_id + self._id_shift) % (max_id + 1)
        self._start_ns, self._next_id = start_ns + self._shift_ns, played_id + 1
        self.played_ns = last_ns + self._shift_ns
        return self._shift_ns, played_id


class Rewriter:
    """Rewrites lidar packets of one sensor info in place."""

    def __init__(self, info: core.SensorInfo, timeline: Timeline):
        self._format, self._timeline = core.PacketFormat.from_info(info), timeline
        self._packet = core.LidarPacket(self._format)
        self.buffer = self._packet.buf
        columns = info.format.columns_per_packet
        start, size = self._format.packet_header_size, self._format.col_size
        by_column = self.buffer[start : start + columns * size].reshape(columns, size)
        self._times = by_column[:, :8].view("<i8")[:, 0]
        self._columns = by_column[:, COLUMN_ID_OFFSET : COLUMN_ID_OFFSET + 2].view("<u2")[:, 0]
        self._column_ns = 1e9 / info.format.fps / info.format.columns_per_frame
        self._has_ids = info.format.udp_profile_lidar != core.UDPProfileLidar.LEGACY

    def rewrite(self, payload: bytes | np.ndarray, clock_ns: int, ids: tuple[int, int]) -> int | None:
        """Puts a packet into `buffer`; clock_ns: the sensor's clock at played time 0, ids: serial, init id.

        Returns the played time of its last column, ns, or None where no column has a time.
        """
        self.buffer[:] = np.frombuffer(payload, np.uint8)
        timed = self._times > 0
        if not timed.any():
            return None
        times = self._times[timed]
        last = int(times.argmax())
        last_ns = int(times[last])
        start_ns = last_ns - round(int(self._columns[timed][last]) * self._column_ns)
        shift_ns, frame_id = self._timeline.place(start_ns, last_ns, self._packet.frame_id(), self._format.max_frame_id)
        self._times[timed] = times + (shift_ns + clock_ns)
        self._format.set_frame_id(self._packet, frame_id)
        if self._has_ids:
            self._put(ids)
        return last_ns + shift_ns

    def _put(self, ids: tuple[int, int]) -> None:
        init_at, serial_at = PLACES[self._format.max_frame_id]
        serial, init_id = ids
        self._write(init_at, init_id, ID_BYTES)
        self._write(serial_at, serial, SERIAL_BYTES)
        if self._packet.crc() is not None:
            self._write(len(self.buffer) - CRC_BYTES, self._packet.calculate_crc(), CRC_BYTES)

    def _write(self, at: int, value: int, size: int) -> None:
        self.buffer[at : at + size] = np.frombuffer(value.to_bytes(size, "little"), np.uint8)


def shift_imu(payload: bytes, shift_ns: int) -> bytes:
    """A LEGACY IMU packet with its times moved."""
    times = np.frombuffer(payload, "<i8", IMU_TIMES) + shift_ns
    return times.tobytes() + payload[times.nbytes :]
