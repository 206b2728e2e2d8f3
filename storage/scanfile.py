"""The bytes of a scan file.

    offset  size  what (little endian)
    0       8     magic "RVSDSCAN"
    8       2     format version
    10      4     length of the header
    14      4     length of the body
    18      4     CRC-32 of header and body
    22      ...   header: JSON (UTF-8): the scalars, the poses row by row, "shape" and "parts" [[name, bytes], ...]
    ...     ...   body: the parts, one after the other

Ranges are split into byte planes (all lowest bytes, all second bytes, ...) before they are compressed: the
high planes change slowly over an image and nearly vanish, which makes the file a third smaller than zstd on the
words as they are. The planes above the highest byte in use are left out. Nothing is rounded.
"""

from __future__ import annotations

import dataclasses
import json
import math
import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import zstandard
from pydantic import BaseModel, ConfigDict, Field

from .errors import ScanFileError

if TYPE_CHECKING:
    from .scans import Scan

MAGIC = b"RVSDSCAN"
VERSION = 1
ZSTD_LEVEL = 3
PREFIX = struct.Struct("<8sHIII")
ARRAYS = ("range_mm", "reflectivity", "column_ns", "column_valid", "descriptor")
POSES = ("T_map_sensor", "T_odom_sensor", "T_start_end")
HINT = "`revisitd fsck --repair` puts it aside; the other scans are not concerned"
Int64 = Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
Side = Annotated[int, Field(ge=1, le=1 << 14)]  # of an image, pixels
Pose = Annotated[list[float], Field(min_length=16, max_length=16)]


class _Header(BaseModel):
    """The JSON in front, each value of the type and within the limits of what is written."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    scan_id: Int64
    session: Int64
    stamp_ns: Int64
    host_ns: Int64
    frame_id: Int64
    sensor_digest: str
    model_id: str
    aligned: bool
    alignment_residual_m: float | None
    T_map_sensor: Pose
    T_odom_sensor: Pose
    T_start_end: Pose
    shape: tuple[Side, Side]
    parts: list[tuple[str, Int64]]


def encode(scan: Scan) -> bytes:
    """A Scan -> the bytes of its file."""
    parts = {
        "range_mm": _compress(_byte_planes(scan.range_mm)),
        "reflectivity": _compress(np.ascontiguousarray(scan.reflectivity, np.uint8)),
        "column_ns": _compress(_byte_planes(_steps(scan.column_ns).view(np.uint64))),
        "column_valid": np.packbits(scan.column_valid).tobytes(),
        "descriptor": np.asarray(scan.descriptor, "<f4").tobytes(),
    }
    header = {
        field.name: getattr(scan, field.name) for field in dataclasses.fields(scan) if field.name not in ARRAYS + POSES
    }
    if math.isnan(scan.alignment_residual_m):
        header["alignment_residual_m"] = None  # JSON has no NaN
    for name in POSES:
        header[name] = np.asarray(getattr(scan, name), np.float64).ravel().tolist()
    header["shape"] = list(scan.range_mm.shape)
    header["parts"] = [[name, len(part)] for name, part in parts.items()]
    head = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    body = b"".join(parts.values())
    prefix = PREFIX.pack(MAGIC, VERSION, len(head), len(body), zlib.crc32(body, zlib.crc32(head)))
    return prefix + head + body


def decode(data: bytes, path: Path, images: bool = True) -> dict[str, Any]:
    """The bytes of a file -> the fields of a Scan. Raises ScanFileError, which names `path`.

    images False: range_mm and reflectivity stay compressed, and are None.
    """
    head, body = _checked(data, path)
    try:
        fields = dict(_Header.model_validate_json(head))
        height, width = fields.pop("shape")
        parts, start = {}, 0
        for name, length in fields.pop("parts"):
            parts[name] = body[start : start + length]
            start += length
        for name in POSES:
            fields[name] = np.array(fields[name]).reshape(4, 4)
        if fields["alignment_residual_m"] is None:
            fields["alignment_residual_m"] = math.nan
        fields.update(_arrays(parts, height, width, images))
    except (KeyError, ValueError, zstandard.ZstdError) as error:
        # The checksum held, so the disk is not to blame: whoever wrote the file did something else.
        why = " ".join(str(error).split())  # pydantic's come in several lines
        raise ScanFileError(f"{path}: not laid out as version {VERSION} has it ({why}); {HINT}") from error
    return fields


def _arrays(parts: dict[str, memoryview], height: int, width: int, images: bool) -> dict[str, np.ndarray | None]:
    """The arrays of a Scan from the parts of the body."""
    steps = _from_byte_planes(_decompress(parts["column_ns"], 8 * width), (width,), np.dtype("<u8"))
    valid_bits = np.frombuffer(parts["column_valid"], np.uint8, -(-width // 8))
    range_mm = reflectivity = None
    if images:
        planes = _decompress(parts["range_mm"], 4 * height * width)
        range_mm = _from_byte_planes(planes, (height, width), np.dtype("<u4"))
        reflectivity = np.frombuffer(_decompress(parts["reflectivity"], height * width), np.uint8)
        reflectivity = reflectivity.reshape(height, width)
    return {
        "range_mm": range_mm,
        "reflectivity": reflectivity,
        "column_ns": np.cumsum(steps.view(np.int64)),
        "column_valid": np.unpackbits(valid_bits, count=width).astype(bool),
        "descriptor": np.frombuffer(parts["descriptor"], "<f4").astype(np.float32),
    }


def _checked(data: bytes, path: Path) -> tuple[bytes, memoryview]:
    """Header and body of a file that is whole."""
    if len(data) < PREFIX.size:
        raise ScanFileError(f"{path}: cut short: {len(data)} bytes, not even the first {PREFIX.size}; {HINT}")
    magic, version, head_length, body_length, checksum = PREFIX.unpack_from(data)
    if magic != MAGIC:
        raise ScanFileError(f"{path}: not a scan file: it begins with {magic!r}, not {MAGIC!r}; {HINT}")
    if version > VERSION:
        raise ScanFileError(
            f"{path}: format {version}, by a newer revisitd; this one reads up to {VERSION}: upgrade it"
        )
    expected = PREFIX.size + head_length + body_length
    if len(data) != expected:
        raise ScanFileError(f"{path}: cut short or damaged: {len(data)} bytes of {expected}; {HINT}")
    if zlib.crc32(memoryview(data)[PREFIX.size :]) != checksum:
        raise ScanFileError(f"{path}: damaged: its checksum does not match; {HINT}")
    body_start = PREFIX.size + head_length
    return data[PREFIX.size : body_start], memoryview(data)[body_start:]


def _compress(array: np.ndarray) -> bytes:
    # A fresh one each time: they must not be shared between threads, and making one costs microseconds.
    return zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(array)


def _decompress(data: memoryview, most_bytes: int) -> bytes:
    """Raises ValueError where it would become larger: a damaged length must not take all memory."""
    size = zstandard.frame_content_size(data)
    if not 0 <= size <= most_bytes:
        raise ValueError(f"a part of {size} bytes where {most_bytes} are the most")
    return zstandard.ZstdDecompressor().decompress(data)


def _byte_planes(words: np.ndarray) -> np.ndarray:
    """Unsigned words (...,) -> (P, ...) uint8: their P lowest bytes, P as small as holds them all."""
    little = np.ascontiguousarray(words, words.dtype.newbyteorder("<"))
    n_planes = max(1, (int(little.max(initial=0)).bit_length() + 7) // 8)
    bytes_last = little.view(np.uint8).reshape(*words.shape, words.dtype.itemsize)
    return np.ascontiguousarray(np.moveaxis(bytes_last[..., :n_planes], -1, 0))


def _from_byte_planes(data: bytes, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """The reverse of _byte_planes: words of this shape and dtype."""
    planes = np.frombuffer(data, np.uint8).reshape(-1, *shape)  # an error where they are not whole
    words = np.zeros(shape, dtype)
    bytes_last = words.view(np.uint8).reshape(*shape, dtype.itemsize)
    for i, plane in enumerate(planes):
        bytes_last[..., i] = plane
    return words


def _steps(times: np.ndarray) -> np.ndarray:
    """int64 (W,) -> its differences, the first against 0: column times grow by nearly equal steps."""
    return np.diff(np.asarray(times, np.int64), prepend=np.int64(0))
