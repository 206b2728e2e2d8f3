"""The first packets of a capture: what there is, whose it is, and one line on why none is of use."""

import ipaddress
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from .datagrams import Reassembler
from .errors import BadCapture, BadMetadata, DriverError
from .losses import Loss
from .packets import PacketFilter
from .pcap import PcapFile, Record

ENOUGH = 500  # datagrams, half a second: by then a sensor that is there has been seen
MOST = 20_000
SHOWN = 4
LEGACY_SIZES = (3392, 6464, 12608, 24896)  # 16, 32, 64, 128 beams
LEAST_LIDAR_BYTES = 700  # IMU and zone packets are smaller
Stream = tuple[bytes, int, int]  # sender's address, port it sent to, bytes of a packet


@dataclass
class Verdict:
    """How one metadata file fits the packets of a capture."""

    filter: PacketFilter
    faults: Counter = field(default_factory=Counter)  # Loss -> datagrams
    senders: set[bytes] = field(default_factory=set)  # of packets that fit
    other_ports: Counter = field(default_factory=Counter)  # port -> packets that would fit but for their port
    other_ids: Counter = field(default_factory=Counter)  # (serial, init id) of packets that fit but for those
    good: int = 0

    @property
    def fits(self) -> bool:
        """Whether the packets are those of the metadata; stray columns are tolerated, half a turn is not."""
        return self.good > 10 * self.faults[Loss.WRONG_COLUMN]

    def add(self, payload: bytes, sender: bytes, port: int) -> None:
        fault = self.filter.fault(payload, port)
        if fault is None:
            self.good += 1
            self.senders.add(sender)
            return
        self.faults[fault] += 1
        if fault in (Loss.OTHER_SENSOR, Loss.OTHER_INIT_ID):
            self.other_ids[self.filter.ids(payload)] += 1
        elif port != self.filter.port and not self.filter.fault(payload, self.filter.port):
            self.other_ports[port] += 1


class Survey:
    """Looks at the beginning of a capture through the eyes of each candidate metadata."""

    def __init__(self, path: Path, filters: list[PacketFilter]):
        self.path = path
        self.verdicts = [Verdict(candidate) for candidate in filters]
        self.streams: Counter[Stream] = Counter()
        self.losses: Counter = Counter()
        self.records = 0
        self.datagrams = 0
        self.has_ouster_packets = False
        with PcapFile(path, self.losses) as file:
            self._read(file)
            self.bytes_read, self.size = file.position(), file.size

    def _read(self, file: PcapFile) -> None:
        for datagram in Reassembler(self.losses).datagrams(self._counted(file)):
            sender = datagram.source[0]
            self.datagrams += 1
            self.streams[sender, datagram.port, len(datagram.payload)] += 1
            self.has_ouster_packets |= _looks_like_ouster(datagram.payload)
            for verdict in self.verdicts:
                verdict.add(datagram.payload, sender, datagram.port)
            if self.datagrams >= MOST or self.datagrams >= ENOUGH and any(v.fits for v in self.verdicts):
                return

    def _counted(self, file: PcapFile) -> Iterator[Record]:
        for record in file:
            self.records += 1
            yield record

    def seen(self) -> str:
        """What the capture holds, for people: '64 of 8448 bytes to port 7502 from 10.0.0.1, ...'."""
        if not self.records:
            return "no packets at all"
        if not self.datagrams:
            return f"{self.records} network packets but no whole UDP packet ({_causes(self.losses)})"
        shown = [
            f"{count} of {size} bytes to port {port} from {ipaddress.ip_address(sender)}"
            for (sender, port, size), count in self.streams.most_common(SHOWN)
        ]
        rest = len(self.streams) - len(shown)
        more = f" and {rest} other kinds" if rest > 0 else ""
        first = "first " if self.datagrams >= MOST else ""
        plural = "" if self.datagrams == 1 else "s"
        return f"{first}{self.datagrams} UDP packet{plural}: {', '.join(shown)}{more}"

    def require_packets(self) -> None:
        """Raises BadCapture where there is nothing to look at."""
        if not self.datagrams:
            raise BadCapture(f"{self.path} ({self.size} bytes) holds {self.seen()}: record again")

    def require_one_sender(self, verdict: Verdict) -> None:
        """Raises BadCapture where packets that name no sensor come from several."""
        if len(verdict.senders) > 1 and not verdict.filter.has_ids:
            senders = ", ".join(sorted(str(ipaddress.ip_address(sender)) for sender in verdict.senders))
            raise BadCapture(
                f"{self.path} holds LEGACY packets of like sensors at {senders}, which cannot be told apart: "
                "give a capture of one (tcpdump host ADDRESS)"
            )

    def error(self, verdict: Verdict, metadata: str) -> DriverError:
        """Why no packet of the capture fits the metadata of this name."""
        expected, here, seen = verdict.filter, self.path, f"seen {self.seen()}"
        if verdict.other_ports:
            return BadMetadata(
                f"{metadata} says udp_port_lidar {expected.port}, but in {here} this sensor's packets go to "
                f"port {_listed(verdict.other_ports)}: correct the metadata; {seen}"
            )
        if verdict.other_ids:
            return BadMetadata(f"{_id_mismatch(verdict, metadata, here)}; {seen}")
        if verdict.faults[Loss.WRONG_SIZE]:
            return BadMetadata(
                f"{metadata} is for packets of {expected.size} bytes ({expected.profile}, {expected.beams} "
                f"beams), but {here} has none: give the metadata saved with it; {seen}"
            )
        if verdict.faults[Loss.WRONG_COLUMN]:
            return BadMetadata(
                f"{metadata} has {expected.columns} columns a turn, but {here} was recorded with more: give "
                f"the metadata saved with it; {seen}"
            )
        if set(verdict.faults) <= {Loss.IMU_PACKET, Loss.ZONE_PACKET}:
            return BadCapture(f"{here} holds no lidar packets: the lidar was off; {seen}")
        port = f"port {expected.port}, where {metadata} has the lidar" if expected.port else "any port"
        return BadCapture(
            f"{here} holds no lidar packets at {port}: another sensor, a wrong port, or the lidar was off; "
            f"{seen}"
        )


def _looks_like_ouster(payload: bytes) -> bool:
    """Whether it has the size of a LEGACY lidar packet, or begins as the other profiles' do."""
    return len(payload) in LEGACY_SIZES or (len(payload) >= LEAST_LIDAR_BYTES and payload[0] == 1)


def _id_mismatch(verdict: Verdict, metadata: str, path: Path) -> str:
    serial, init_id = verdict.filter.expected_ids
    init_ids: Counter = Counter()
    serials: Counter = Counter()
    for (other_serial, other_init_id), count in verdict.other_ids.items():
        serials[other_serial] += count
        if other_serial == serial:
            init_ids[other_init_id] += count
    if init_ids:
        return (
            f"{metadata} is of init id {init_id}, but {path} was recorded at init id {_listed(init_ids)}: "
            f"the sensor was restarted or reconfigured in between, give the metadata saved with it"
        )
    return (
        f"{metadata} is of sensor {serial}, but {path} was recorded from sensor {_listed(serials)}: "
        f"give the metadata of that one"
    )


def _listed(counts: Counter) -> str:
    shown = [str(value) for value, _ in counts.most_common(SHOWN)]
    return ", ".join(shown) + (", ..." if len(counts) > len(shown) else "")


def _causes(losses: Counter) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in losses.most_common())
