"""A pcap file with its metadata -> Frames."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from .beside import match_metadata
from .datagrams import Datagram, Reassembler
from .frame import Frame
from .losses import Loss
from .metadata import sensor_from_info
from .packets import FrameAssembler, packets_per_frame
from .pcap import PcapFile
from .source import Source


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
            for lidar_frame in assembler.add(assembler.packet(datagram.payload, datagram.time_ns)):
                yield from self._frames(lidar_frame)
        for lidar_frame in assembler.flush():
            yield from self._frames(lidar_frame)

    def close(self) -> None:
        self._file.close()

    def _fault(self, datagram: Datagram) -> Loss | None:
        if self._sender and datagram.source[0] != self._sender:
            return Loss.OTHER_SENSOR
        return self._filter.fault(datagram.payload, datagram.port)
