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
IPV4 = struct.Struct(">BxHHHxBxx8s")  # version and length, total, identity, flags, protocol, addresses


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
            if datagram := self._datagram(record):
                yield datagram
        for _ in self._pending:
            self._lose(Loss.LOST_FRAGMENT)
        self._pending.clear()

    def _datagram(self, record: Record) -> Datagram | None:
        """The datagram that this record completes, if it does."""
        time_ns, link_type, data, whole = record
        if not whole:
            return self._lose(Loss.CUT_RECORD)
        start = _ip_start(data, link_type)
        version = data[start] >> 4 if 0 <= start < len(data) else 0
        if version == 4 and len(data) >= start + 20:
            return self._ipv4(time_ns, data, start)
        if version == 6 and len(data) >= start + 48:
            return self._ipv6(time_ns, data, start)
        return self._lose(Loss.NOT_UDP)

    def _ipv4(self, time_ns: int, data: bytes, start: int) -> Datagram | None:
        first, total, identity, flags, protocol, addresses = IPV4.unpack_from(data, start)
        if protocol != UDP:
            return self._lose(Loss.NOT_UDP)
        end = start + total if total else len(data)  # 0 where the network card was left to split the packet
        part = data[start + 4 * (first & 15) : end]
        return self._place(time_ns, addresses, identity, part, 8 * (flags & 0x1FFF), bool(flags & 0x2000))

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
        if fragments is None or offset in fragments.parts:
            self._begin(key, fragments)
            fragments = self._pending[key]
        fragments.parts[offset] = part
        fragments.received += len(part)
        if not more:
            fragments.total = offset + len(part)
        if fragments.received != fragments.total:
            return None
        del self._pending[key]
        whole = b"".join(fragments.parts[at] for at in sorted(fragments.parts))
        return self._udp(time_ns, addresses, whole)

    def _begin(self, key: tuple, same: "_Fragments | None") -> None:
        """Makes room for a datagram; `same` has its identity, which has 16 bits and so comes round."""
        if same:
            del self._pending[key]
            self._lose(Loss.LOST_FRAGMENT)
        elif len(self._pending) >= MAX_PENDING:
            del self._pending[next(iter(self._pending))]
            self._lose(Loss.LOST_FRAGMENT)
        self._pending[key] = _Fragments()

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


def _ip_start(data: bytes, link_type: int) -> int:
    """Offset of the IP header in a record, -1 where there is none."""
    if link_type == 1 and data[12:14] in ETHERTYPES:
        return 14
    if link_type not in FRAMED:
        return BARE.get(link_type, -1)
    at, start = FRAMED[link_type]
    while data[at : at + 2] in VLAN_TAGS:
        at, start = at + 4, start + 4
    return start if data[at : at + 2] in ETHERTYPES else -1
