"""The packets of a capture, one pass after another."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ..beside import match_metadata
from ..datagrams import Reassembler
from ..errors import BadCapture
from ..losses import Loss
from ..packets import PacketFilter
from ..pcap import PcapFile

IMU_BYTES = 48  # of the LEGACY profile; the other one's packets are parts of frames


class Capture:
    """A pcap file and its metadata. Raises BadCapture, BadMetadata or SourceNotFound."""

    def __init__(self, path: Path, meta: Path | None):
        if path.suffix.lower() == ".osf":
            raise BadCapture(f"{path} holds frames, not the packets that a sensor sends: give a pcap")
        metadata, _, verdict = match_metadata(path, meta)
        self.metadata, self.info = metadata.text, metadata.info
        self.filter: PacketFilter = verdict.filter
        self._path = path

    def passes(self, loop: bool) -> Iterator[Iterator[bytes]]:
        """The payloads of its lidar and IMU packets, in order; without end if looped."""
        yield self._payloads()
        while loop:
            yield self._payloads()

    def _payloads(self) -> Iterator[bytes]:
        losses: Counter = Counter()
        with PcapFile(self._path, losses) as file:
            for datagram in Reassembler(losses).datagrams(file):
                fault = self.filter.fault(datagram.payload, datagram.port)
                if fault is None or (fault is Loss.IMU_PACKET and len(datagram.payload) == IMU_BYTES):
                    yield datagram.payload
