"""A capture's packets -> those of the same rotations in another profile, lidar mode or azimuth window."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
from ouster.sdk import core

from ..packets import FrameAssembler

STATUS_VALID = 1


class Transcoder:
    """Takes packets of one sensor info and gives, a rotation later, those of another of the same beams and rate."""

    def __init__(self, recorded: core.SensorInfo, wanted: core.SensorInfo):
        fields = tuple(kind.name for kind in core.get_field_types(recorded))
        self._assembler = FrameAssembler(recorded, Counter(), fields)
        self._info, self._format = wanted, core.PacketFormat.from_info(wanted)
        columns = wanted.format.columns_per_frame
        self._column = np.arange(columns) * recorded.format.columns_per_frame // columns  # that it is made of
        first, last = wanted.format.column_window
        column = np.arange(columns)
        self._sent = (column >= first) & (column <= last) if first <= last else (column >= first) | (column <= last)

    def packets(self, payload: bytes) -> Iterator[core.LidarPacket]:
        """The packets of the rotation that this payload of the capture completes, if it does."""
        for frame in self._assembler.add(self._assembler.packet(payload, 1)):
            yield from core.frame_to_packets(self._frame(frame), self._format, self._info.init_id, self._info.sn)

    def _frame(self, recorded: core.LidarFrame) -> core.LidarFrame:
        frame = core.LidarFrame(self._info)
        frame.frame_id = recorded.frame_id
        frame.measurement_id[:] = np.arange(len(self._column))
        frame.status[:] = np.where(self._sent, recorded.status[self._column], 0)
        frame.timestamp[:] = self._column_times(recorded)
        per_packet = self._info.format.columns_per_packet
        has_columns = (frame.status & STATUS_VALID).reshape(-1, per_packet).any(axis=1)
        frame.packet_timestamp[:] = has_columns  # a packet without a time is not made
        for name in frame.fields:
            if recorded.has_field(name):
                mask = self._format.field_value_mask(name)
                frame.field(name)[:] = recorded.field(name)[:, self._column].astype(np.uint64) & np.uint64(mask)
        return frame

    def _column_times(self, recorded: core.LidarFrame) -> np.ndarray:
        """(W,) uint64 ns; of several columns made of one, each its own."""
        times = recorded.timestamp[self._column].astype(np.int64)
        period_ns = round(1e9 / self._info.format.fps)
        repeats = max(1, len(self._column) // len(recorded.timestamp))
        return times + np.arange(len(self._column)) % repeats * (period_ns // len(self._column))
