"""Ouster sensors, live or recorded -> Frames."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from ouster.sdk import core

from .beside import match_metadata
from .datagrams import Datagram, Reassembler
from .errors import SourceNotFound
from .frame import Frame
from .losses import Loss
from .metadata import sensor_from_info, sensor_from_metadata
from .packets import FrameAssembler, frame_from_sdk
from .pcap import PcapFile
from .source import Source

__all__ = ["open_source", "sensor_from_metadata", "PcapSource"]
FILE_SUFFIXES = (".pcap", ".pcapng", ".osf")


def open_source(source: str, meta: Path | None = None) -> Source:
    """source: a pcap or OSF file, or a sensor's name or address. meta: metadata, where it is not beside it.

    Raises SourceNotFound, BadMetadata, BadCapture or SensorUnavailable.
    """
    path = Path(source)
    if path.is_dir():
        raise SourceNotFound(f"{source} is a folder: give a pcap or OSF file, or a sensor's name")
    if not path.exists():
        raise SourceNotFound(f"there is no file {source}")
    return PcapSource(path, meta)


class PcapSource(Source):
    """A capture, read at the speed of the reader."""

    def __init__(self, path: Path, meta: Path | None = None):
        metadata, survey, verdict = match_metadata(path, meta)
        self.sensor = sensor_from_info(metadata.info, metadata.text)
        self.losses: Counter = Counter()
        self._info = metadata.info
        self._filter = verdict.filter
        self._sender = None if verdict.filter.has_ids else next(iter(verdict.senders))
        self._file = PcapFile(path, self.losses)
        packets = verdict.good * survey.size / survey.bytes_read
        self.n_frames_estimate = math.ceil(packets / packets_per_frame(metadata.info))

    def __iter__(self) -> Iterator[Frame]:
        assembler = FrameAssembler(self._info, self.losses)
        for datagram in Reassembler(self.losses).datagrams(self._file):
            fault = self._fault(datagram)
            if fault:
                self.losses[fault] += 1
                continue
            for lidar_frame in assembler.add(datagram.payload, datagram.time_ns):
                yield from self._frame(lidar_frame)
        for lidar_frame in assembler.flush():
            yield from self._frame(lidar_frame)

    def close(self) -> None:
        self._file.close()

    def _fault(self, datagram: Datagram) -> Loss | None:
        if self._sender and datagram.source[0] != self._sender:
            return Loss.OTHER_SENSOR
        return self._filter.fault(datagram.payload, datagram.port)

    def _frame(self, lidar_frame: core.LidarFrame) -> Iterator[Frame]:
        frame = frame_from_sdk(lidar_frame, self.sensor)
        if frame:
            yield frame
        else:
            self.losses[Loss.EMPTY_FRAME] += 1


def packets_per_frame(info: core.SensorInfo) -> int:
    """Packets that a rotation is sent in: those that touch the column window."""
    first, last = info.format.column_window
    columns = info.format.columns_per_frame
    in_window = np.arange(first, last + 1 if first <= last else last + 1 + columns) % columns
    return len(np.unique(in_window // info.format.columns_per_packet))
