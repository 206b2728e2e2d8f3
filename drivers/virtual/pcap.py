"""UDP packets -> pcap records, as a capture tool would have stored them: Ethernet, IPv4 in fragments, UDP.

Our own, since the SDK's recorder numbers its IP packets by a counter of the process: equal frames would give
other bytes each time.
"""

import struct

import numpy as np

FILE_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
RECORD_BYTES, ETHERNET_BYTES, IP_BYTES, UDP_BYTES = 16, 14, 20, 8
HEAD_BYTES = RECORD_BYTES + ETHERNET_BYTES + IP_BYTES
FRAGMENT_BYTES = 1480  # of IP payload: an MTU of 1500
ADDRESS = bytes([127, 0, 0, 1])
MORE_FRAGMENTS = 0x2000


class Records:
    """Lays out packets of one size, sent from and to one port."""

    def __init__(self, packet_bytes: int, port: int):
        udp = packet_bytes + UDP_BYTES
        self._starts = list(range(0, udp, FRAGMENT_BYTES))
        self._sizes = [min(FRAGMENT_BYTES, udp - start) for start in self._starts]
        heads = [_head(start, size, start + size < udp) for start, size in zip(self._starts, self._sizes, strict=True)]
        heads[0] += struct.pack(">HHHH", port, port, udp, 0)
        self._heads = [np.frombuffer(head, np.uint8) for head in heads]

    def __call__(self, packets: np.ndarray, host_ns: np.ndarray, first_number: int) -> bytes:
        """packets: (N, size) uint8, host_ns: (N,) int64, first_number: packets before these -> N records."""
        number = (first_number + np.arange(len(packets))) % 65536
        clock = np.stack([host_ns // 10**9, host_ns % 10**9 // 1000], 1).astype("<u4").view(np.uint8)
        pieces = []
        for start, size, head in zip(self._starts, self._sizes, self._heads, strict=True):
            top = np.repeat(head[None], len(packets), 0)
            top[:, :8] = clock
            ip = top[:, RECORD_BYTES + ETHERNET_BYTES : HEAD_BYTES]
            ip[:, 4:6] = number[:, None] >> [8, 0] & 255
            ip[:, 10:12] = _checksum(ip)[:, None] >> [8, 0] & 255
            first = max(0, start - UDP_BYTES)
            pieces += [top, packets[:, first : start - UDP_BYTES + size]]
        return np.concatenate(pieces, axis=1).tobytes()


def _head(start: int, size: int, more: bool) -> bytes:
    captured = ETHERNET_BYTES + IP_BYTES + size
    record = struct.pack("<IIII", 0, 0, captured, captured)
    ethernet = bytes(12) + b"\x08\x00"
    flags = start // 8 | (MORE_FRAGMENTS if more else 0)
    return record + ethernet + struct.pack(">BBHHHBBH", 0x45, 0, IP_BYTES + size, 0, flags, 64, 17, 0) + 2 * ADDRESS


def _checksum(ip: np.ndarray) -> np.ndarray:
    """ip: (N, 20) uint8 headers whose checksum is 0 -> (N,) one's complement sum."""
    words = ip[:, 0::2].astype(np.int64) * 256 + ip[:, 1::2]
    total = words.sum(1)
    total = (total & 0xFFFF) + (total >> 16)
    return ~((total & 0xFFFF) + (total >> 16)) & 0xFFFF
