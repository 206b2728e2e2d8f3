"""Network packets -> the UDP datagrams that they carry; a sensor's packet is split over up to 17 of them."""

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from .losses import Loss
from .pcap import Record

MAX_PENDING = 64  # datagrams with missing parts; of more than that, the oldest has lost one for good
UDP = 17
IPV6_FRAGMENT = 44
ETHERTYPES = (b"\x08\x00", b"\x86\xdd")
VLAN_TAGS = (b"\x81\x00", b"\x88\xa8")
# Link type -> where the ethertype and the IP header lie: Ethernet, Linux "cooked" v1 and v2.
FRAMED = {1: (12, 14), 113: (14, 16), 276: (0, 20)}
# Link type -> where the IP header lies: BSD loopback, then bare IP.
BARE = {0: 4, 108: 4, 12: 0, 101: 0, 228: 0, 229: 0}


class Datagram(NamedTuple):
    """One UDP datagram, put together from its fragments."""

    time_ns: int  # of its last fragment, host epoch
    source: tuple[bytes, int]  # IP address (4 or 16 bytes) and port of the sender
    port: int  # where it was sent to
    payload: bytes


class Reassembler:
    """Turns records into datagrams, in order, and counts what is lost."""

    def __init__(self, losses: Counter):
        self._losses = losses
        self._pending: dict[tuple, _Fragments] = {}

    def datagrams(self, records: Iterable[Record]) -> Iterator[Datagram]:
        for record in records:
            datagram = self._datagram(record)
            if datagram:
                yield datagram
        for _ in self._pending:
            self._lose(Loss.LOST_FRAGMENT)
        self._pending.clear()

    def _datagram(self, record: Record) -> Datagram | None:
        """The datagram that this record completes, if it does."""
        if not record.whole:
            return self._lose(Loss.CUT_RECORD)
        data, start = record.data, _ip_start(record.data, record.link_type)
        version = data[start] >> 4 if 0 <= start < len(data) else 0
        if version == 4 and len(data) >= start + 20:
            return self._ipv4(record.time_ns, data, start)
        if version == 6 and len(data) >= start + 48:
            return self._ipv6(record.time_ns, data, start)
        return self._lose(Loss.NOT_UDP)

    def _ipv4(self, time_ns: int, data: bytes, start: int) -> Datagram | None:
        if data[start + 9] != UDP:
            return self._lose(Loss.NOT_UDP)
        total, identity, flags = struct.unpack_from(">HHH", data, start + 2)
        body = start + 4 * (data[start] & 15)
        end = start + total if total else len(data)  # 0 where the network card was left to split the packet
        addresses = data[start + 12 : start + 20]
        part, offset, more = data[body:end], 8 * (flags & 0x1FFF), bool(flags & 0x2000)
        return self._place(time_ns, addresses, identity, part, offset, more)

    def _ipv6(self, time_ns: int, data: bytes, start: int) -> Datagram | None:
        length, following = struct.unpack_from(">HB", data, start + 4)
        addresses, body = data[start + 8 : start + 40], start + 40
        end, identity, offset, more = body + length, 0, 0, False
        if following == IPV6_FRAGMENT:
            following, flags, identity = struct.unpack_from(">BxHI", data, body)
            offset, more, body = flags & 0xFFF8, bool(flags & 1), body + 8
        if following != UDP:
            return self._lose(Loss.NOT_UDP)
        return self._place(time_ns, addresses, identity, data[body:end], offset, more)

    def _place(
        self, time_ns: int, addresses: bytes, identity: int, part: bytes, offset: int, more: bool
    ) -> Datagram | None:
        if offset == 0 and not more:
            return self._udp(time_ns, addresses, part)
        key = (addresses, identity)
        fragments = self._pending.get(key)
        if fragments and offset in fragments.parts:  # the 16-bit identity came round again
            del self._pending[key]
            self._lose(Loss.LOST_FRAGMENT)
            fragments = None
        if not fragments:
            fragments = self._pending[key] = _Fragments()
        fragments.add(part, offset, more)
        if fragments.complete():
            del self._pending[key]
            return self._udp(time_ns, addresses, fragments.join())
        if len(self._pending) > MAX_PENDING:
            del self._pending[next(iter(self._pending))]
            self._lose(Loss.LOST_FRAGMENT)
        return None

    def _udp(self, time_ns: int, addresses: bytes, data: bytes) -> Datagram | None:
        source_port, port, length = struct.unpack_from(">HHH", data) if len(data) >= 8 else (0, 0, 8)
        if len(data) < max(length, 8):
            return self._lose(Loss.CUT_RECORD)
        payload = data[8 : length or None]
        return Datagram(time_ns, (addresses[: len(addresses) // 2], source_port), port, payload)

    def _lose(self, cause: Loss) -> None:
        self._losses[cause] += 1


class _Fragments:
    """The parts of one datagram that have arrived."""

    __slots__ = ("parts", "received", "total")

    def __init__(self):
        self.parts: dict[int, bytes] = {}
        self.received = 0
        self.total = -1

    def add(self, part: bytes, offset: int, more: bool) -> None:
        self.parts[offset] = part
        self.received += len(part)
        if not more:
            self.total = offset + len(part)

    def complete(self) -> bool:
        return self.received == self.total

    def join(self) -> bytes:
        return b"".join(self.parts[offset] for offset in sorted(self.parts))


def _ip_start(data: bytes, link_type: int) -> int:
    """Offset of the IP header in a record, -1 where there is none."""
    if link_type not in FRAMED:
        return BARE.get(link_type, -1)
    at, start = FRAMED[link_type]
    while data[at : at + 2] in VLAN_TAGS:
        at, start = at + 4, start + 4
    return start if data[at : at + 2] in ETHERTYPES else -1
