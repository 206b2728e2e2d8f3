"""Records of a pcap or pcapng file: what a network card saw, one record a network packet.

Read without the SDK, which drops what it cannot use in silence: here every record lost is counted.
Layouts from draft-ietf-opsawg-pcap and -pcapng.
"""

import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from .errors import BadCapture
from .losses import Loss

MAX_RECORD_BYTES = 1 << 18  # libpcap's own limit: a longer record is a damaged length
PCAP_MAGIC = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}  # -> ns in the unit of its fractions
PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
PCAPNG_LITTLE_ENDIAN = b"\x4d\x3c\x2b\x1a"
INTERFACE_BLOCK, PACKET_BLOCK = 1, 6
TIME_RESOLUTION_OPTION = 9
NS_PER_S = 1_000_000_000


class Record(NamedTuple):
    """One captured network packet."""

    time_ns: int  # host epoch
    link_type: int  # tcpdump.org/linktypes.html
    data: bytes
    whole: bool  # False: the recorder's snap length cut it


class PcapFile:
    """Iterates over the records of a file, once. Raises BadCapture at opening where it is no capture."""

    def __init__(self, path: Path, losses: Counter):
        self.size = path.stat().st_size
        self._file = path.open("rb", buffering=1 << 20)
        try:
            self._records = _open_records(self._file, path, self.size, losses)
        except BaseException:
            self._file.close()
            raise

    def __iter__(self) -> Iterator[Record]:
        return self._records

    def position(self) -> int:
        """Bytes read so far."""
        return self._file.tell()

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> "PcapFile":
        return self

    def __exit__(self, *_exception) -> None:
        self.close()


def _open_records(file: BinaryIO, path: Path, size: int, losses: Counter) -> Iterator[Record]:
    if size == 0:
        raise BadCapture(f"{path} is empty (0 bytes): the recording never began, or was not copied")
    header = file.read(24)
    if header[:4] == PCAPNG_MAGIC:
        file.seek(0)
        return _pcapng_records(file, losses)
    for order in "<>":
        magic = int.from_bytes(header[:4], "little" if order == "<" else "big")
        if magic not in PCAP_MAGIC:
            continue
        if len(header) < 24:
            raise BadCapture(f"{path} ends within its file header ({size} of 24 bytes): record again")
        link_type = struct.unpack_from(order + "I", header, 20)[0] & 0xFFFF
        return _pcap_records(file, order, PCAP_MAGIC[magic], link_type, losses)
    raise BadCapture(
        f"{path} is not a pcap or pcapng file (it begins with {header[:4].hex() or 'nothing'}): "
        "give a capture of tcpdump, Wireshark or ouster-cli"
    )


def _pcap_records(
    file: BinaryIO, order: str, unit_ns: int, link_type: int, losses: Counter
) -> Iterator[Record]:
    header = struct.Struct(order + "IIII")
    while head := file.read(16):
        if len(head) < 16:
            losses[Loss.TRUNCATED_RECORD] += 1
            return
        seconds, fraction, stored, sent = header.unpack(head)
        if stored > MAX_RECORD_BYTES:
            losses[Loss.DAMAGED_RECORD] += 1
            return
        data = file.read(stored)
        if len(data) < stored:
            losses[Loss.TRUNCATED_RECORD] += 1
            return
        yield Record(seconds * NS_PER_S + fraction * unit_ns, link_type, data, stored >= sent)


def _pcapng_records(file: BinaryIO, losses: Counter) -> Iterator[Record]:
    order, interfaces = "<", []  # (link type, ticks a second)
    while head := file.read(12):
        if head[:4] == PCAPNG_MAGIC:  # a section has its own byte order and numbers its interfaces from 0
            order, interfaces = "<" if head[8:] == PCAPNG_LITTLE_ENDIAN else ">", []
        if len(head) < 12:
            losses[Loss.TRUNCATED_RECORD] += 1
            return
        kind, length = struct.unpack_from(order + "II", head)
        if not 12 <= length <= MAX_RECORD_BYTES + 4096:
            losses[Loss.DAMAGED_RECORD] += 1
            return
        body = head[8:] + file.read(length - 12)
        if len(body) < length - 8:
            losses[Loss.TRUNCATED_RECORD] += 1
            return
        if kind == INTERFACE_BLOCK and length >= 20:
            link_type = struct.unpack_from(order + "H", body)[0]
            interfaces.append((link_type, _ticks_per_s(body[8:-4], order)))
        elif kind == PACKET_BLOCK and length >= 32:
            number, high, low, stored, sent = struct.unpack_from(order + "IIIII", body)
            if number >= len(interfaces) or stored > length - 32:
                losses[Loss.DAMAGED_RECORD] += 1
                return
            link_type, ticks_per_s = interfaces[number]
            time_ns = ((high << 32) | low) * NS_PER_S // ticks_per_s
            yield Record(time_ns, link_type, body[20 : 20 + stored], stored >= sent)


def _ticks_per_s(options: bytes, order: str) -> int:
    """The interface's time unit, from its options: microseconds where none is given."""
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == TIME_RESOLUTION_OPTION and length >= 1 and at + 4 < len(options):
            exponent = options[at + 4]
            return 1 << (exponent & 0x7F) if exponent & 0x80 else 10 ** min(exponent, 18)
        at += 4 + (length + 3) // 4 * 4
    return 1_000_000
