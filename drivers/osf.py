"""OSF recordings -> Frames."""

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ouster.sdk import core, osf

from .errors import BadCapture, BadMetadata
from .frame import Frame
from .losses import Loss
from .metadata import parse_metadata, sensor_from_info
from .packets import FIELDS
from .source import Source

MAX_BLOCK_BYTES = 64 << 20
WRONG_CHECKSUM = "has a wrong checksum"
METADATA_OFFSET_ENTRY = 4 + 2 * 2  # in the header's vtable: its third field


class OsfSource(Source):
    """A recording of frames. It holds its metadata; one given says which of several sensors is meant."""

    def __init__(self, path: Path, meta_text: str | None = None):
        self._path = path
        self.losses: Counter = Counter()
        self._warnings: list[str] = []
        self._file = self._open()
        try:
            self._index, info = self._pick(meta_text)
            self.sensor = sensor_from_info(info, info.to_json_string())
            self.n_frames_estimate = len(self._file)
        except BaseException:
            self.close()
            raise

    def __iter__(self) -> Iterator[Frame]:
        n_frames = n_warnings = 0
        try:
            for frames in self._file:
                lidar_frame = frames[self._index] if len(frames) > self._index else None
                if len(self._warnings) > n_warnings:  # a field could not be decoded, and is zero
                    n_warnings = len(self._warnings)
                    self.losses[Loss.DAMAGED_RECORD] += 1
                elif lidar_frame and self._is_ours(lidar_frame):
                    n_frames += 1
                    yield from self._frames(lidar_frame)
        except RuntimeError as error:
            raise BadCapture(f"{self._path} cannot be read beyond frame {n_frames}: {error}") from None
        if not n_frames:
            raise BadCapture(f"{self._path} holds no frame that can be read{self._said()}: record again")

    def close(self) -> None:
        self._file.close()

    def _open(self) -> osf.OsfFrameSetSource:
        fault = _fault(self._path)
        if fault:
            raise BadCapture(f"{self._path} ({self._path.stat().st_size} bytes) is damaged: {fault}")
        try:
            file = osf.OsfFrameSetSource(str(self._path), error_handler=self._warn, field_names=list(FIELDS))
        except RuntimeError as error:
            raise BadCapture(f"{self._path} cannot be read: {' '.join(str(error).split())}") from None
        if not len(file):
            sensors = ", ".join(str(info.sn) for info in file.sensor_info) or "no sensor"
            file.close()
            raise BadCapture(
                f"{self._path} ({self._path.stat().st_size} bytes, {sensors}) holds no frames{self._said()}: "
                "it was cut, or its recorder did not end properly"
            )
        return file

    def _warn(self, _severity: core.Severity, message: str) -> None:
        self._warnings.append(" ".join(message.split()).rstrip("."))

    def _said(self) -> str:
        return f" ({self._warnings[0]})" if self._warnings else ""

    def _pick(self, meta_text: str | None) -> tuple[int, core.SensorInfo]:
        infos = list(self._file.sensor_info)
        serials = ", ".join(str(info.sn) for info in infos)
        if meta_text is not None:
            serial = parse_metadata(meta_text).sn
            for index, info in enumerate(infos):
                if info.sn == serial:
                    return index, parse_metadata(info.to_json_string())
            raise BadMetadata(f"the metadata is of sensor {serial}, but {self._path} is of sensor {serials}")
        if len(infos) > 1:
            raise BadMetadata(f"{self._path} holds sensors {serials}: say which with --meta")
        return 0, parse_metadata(infos[0].to_json_string())

    def _is_ours(self, lidar_frame: core.LidarFrame) -> bool:
        """Whether it has the shape of the metadata, and ranges."""
        ours = (lidar_frame.h, lidar_frame.w) == self.sensor.shape and lidar_frame.has_field("RANGE")
        if not ours:
            self.losses[Loss.DAMAGED_RECORD] += 1
        return ours


def _fault(path: Path) -> str | None:
    """What is broken in the parts that the SDK reads unchecked: it crashes the process where they are bad.

    An OSF file is header, chunks, metadata: each with its size before and its CRC-32 after it. The SDK checks
    the chunks' itself.
    """
    with path.open("rb") as file:
        header, fault = _block(file)
        if fault:
            return f"its header {fault}"
        try:
            table = struct.unpack_from("<I", header)[0]
            vtable = table - struct.unpack_from("<i", header, table)[0]
            field_at = struct.unpack_from("<H", header, vtable + METADATA_OFFSET_ENTRY)[0]
            offset = struct.unpack_from("<Q", header, table + field_at)[0]
        except struct.error:
            return "its header is not that of an OSF file"
        if offset >= path.stat().st_size:
            return _chunk_fault(file)
        file.seek(offset)
        _, fault = _block(file)
        return f"its metadata {fault}" if fault else None


def _chunk_fault(file: BinaryIO) -> str | None:
    """In a file whose end with the metadata is missing: there the SDK does not check the chunks either."""
    fault = None
    while not fault:
        _, fault = _block(file)
    return f"its end is missing, and what is left {fault}" if fault == WRONG_CHECKSUM else None


def _block(file: BinaryIO) -> tuple[bytes, str | None]:
    """The block at the file's position, and what is wrong with it."""
    prefix = file.read(4)
    if not prefix:
        return b"", "is missing"
    size = int.from_bytes(prefix, "little")
    if len(prefix) < 4 or size > MAX_BLOCK_BYTES:
        return b"", "is not that of an OSF file"
    body, checksum = file.read(size), file.read(4)
    if len(checksum) < 4:
        return body, "is not complete"
    if int.from_bytes(checksum, "little") != zlib.crc32(prefix + body):
        return body, WRONG_CHECKSUM
    return body, None
