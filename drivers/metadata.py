"""A sensor's metadata (its own JSON) -> Sensor. What the SDK accepts but nobody can use is refused here."""

import hashlib
import json

import numpy as np
from ouster.sdk import core

from .errors import BadMetadata
from .frame import Sensor

core.init_logger("off")  # the SDK logs to stderr; what is worth telling is in our errors and counters

MAX_BEAMS = 256
MAX_COLUMNS = 8192
MAX_COORDINATE_MM = 1e4  # of a sensor's own parts: no Ouster is 10 m wide
NO_LIDAR_PROFILE = "OFF"
# Parts that frames do not depend on; the SDK takes them seriously enough to print about them.
UNUSED_PARTS = ("user_data", "zone_set", "ouster-sdk")
# The SDK's patterns crash the process on a long string; nothing in a sensor's metadata comes near.
MAX_TEXT = 500
MAX_DEPTH = 8
FORMAT_SECTIONS = ("data_format", "lidar_data_format", "imu_data_format")
STATED_GEOMETRY = (
    "beam_altitude_angles",
    "beam_azimuth_angles",
    "beam_to_lidar_transform",
    "lidar_to_sensor_transform",
)
STATED_FORMAT = (
    "pixels_per_column",
    "columns_per_frame",
    "columns_per_packet",
    "column_window",
    "pixel_shift_by_row",
)


def sensor_from_metadata(json_text: str) -> Sensor:
    """json_text: what the sensor answers to GET sensor/metadata, in any of the layouts the SDK reads.

    Raises BadMetadata with one line saying which entry is wrong.
    """
    return sensor_from_info(parse_metadata(json_text), json_text)


def parse_metadata(json_text: str) -> core.SensorInfo:
    """json_text -> the SDK's SensorInfo, whose shape and numbers have been checked. Raises BadMetadata."""
    try:
        document = json.loads(json_text)
    except (ValueError, RecursionError) as error:
        raise BadMetadata(f"metadata is not JSON: {_one_line(error)}") from None
    if not isinstance(document, dict):
        raise BadMetadata("metadata is not a JSON object; give the answer of http://SENSOR/api/v1/sensor/metadata")
    used = {key: value for key, value in document.items() if key not in UNUSED_PARTS}
    if not _is_digestible(used):
        raise BadMetadata("metadata is malformed: it holds a text, list or nesting that is far too long")
    if wild := _wild_entry(used):
        raise BadMetadata(f"metadata is malformed: {wild}")
    try:
        info = core.SensorInfo(json.dumps(used, ensure_ascii=False))
        fault = _fault(info) or _replaced_entry(used, info)
        core.PacketFormat.from_info(info)
    except (RuntimeError, ValueError, TypeError, OverflowError, IndexError, KeyError, MemoryError) as error:
        raise BadMetadata(f"metadata is malformed: {_one_line(error)}") from None
    if fault:
        raise BadMetadata(f"metadata is not usable: {fault}")
    return info


def sensor_from_info(info: core.SensorInfo, json_text: str) -> Sensor:
    """info: from parse_metadata(json_text). Builds the ray table (20-40 ms)."""
    shape = (info.format.pixels_per_column, info.format.columns_per_frame, 3)
    rays = core.XYZLut(info, use_extrinsics=False)
    direction_mm = np.asarray(rays.direction).reshape(shape)
    return Sensor(
        serial=str(info.sn) if info.sn else "",
        product=info.prod_line,
        firmware=info.fw_rev,
        profile=str(info.format.udp_profile_lidar),
        mode=str(info.config.lidar_mode),
        init_id=int(info.init_id),
        timestamp_mode=str(info.config.timestamp_mode or "unknown"),
        metadata=json_text,
        digest=geometry_digest(info),
        frame_period_ns=round(1e9 / info.format.fps),
        column_window=tuple(int(column) for column in info.format.column_window),
        pixel_shift=np.array(info.format.pixel_shift_by_row, np.int32),
        altitude_rad=np.deg2rad(info.beam_altitude_angles).astype(np.float32),
        direction=(direction_mm / np.linalg.norm(direction_mm, axis=-1, keepdims=True)).astype(np.float32),
        offset=np.asarray(rays.offset).reshape(shape).astype(np.float32),
    )


def geometry_digest(info: core.SensorInfo) -> str:
    """16 hex digits over all that says where a return lies: beams, transforms, columns and shifts."""
    whole = [info.format.pixels_per_column, info.format.columns_per_frame, *info.format.pixel_shift_by_row]
    real = [info.beam_altitude_angles, info.beam_azimuth_angles]
    real += [info.beam_to_lidar_transform, info.lidar_to_sensor_transform]
    # Rounded, since another program may have printed other last digits; + 0.0 turns -0 into 0.
    numbers = np.round(np.concatenate([np.ravel(part) for part in real]), 6) + 0.0
    geometry = np.array(whole, "<i8").tobytes() + numbers.astype("<f8").tobytes()
    return hashlib.sha256(geometry).hexdigest()[:16]


def _is_digestible(value: object, depth: int = 0) -> bool:
    """Whether all texts, lists and nestings are of a length that the SDK survives."""
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, list):
        short = depth < MAX_DEPTH and len(value) <= MAX_BEAMS
        return short and all(_is_digestible(part, depth + 1) for part in value)
    return not isinstance(value, str) or len(value) <= MAX_TEXT


def _wild_entry(document: dict) -> str | None:
    """An entry by which the SDK would count, or reserve memory, for minutes."""
    for section in FORMAT_SECTIONS:
        entries = document.get(section)
        for name, value in entries.items() if isinstance(entries, dict) else ():
            if isinstance(value, (int, float)) and not 0 <= value <= MAX_COLUMNS:
                return f"{name} is {value}"
    return None


def _fault(info: core.SensorInfo) -> str | None:
    """What makes this metadata useless, or None."""
    data = info.format
    beams, columns, per_packet = data.pixels_per_column, data.columns_per_frame, data.columns_per_packet
    if str(data.udp_profile_lidar) == NO_LIDAR_PROFILE:
        return "the lidar is switched off (udp_profile_lidar is OFF)"
    if not (0 < beams <= MAX_BEAMS and 0 < columns <= MAX_COLUMNS):
        return f"{beams} beams x {columns} columns"
    if not (0 < per_packet <= columns and columns % per_packet == 0):
        return f"{columns} columns in packets of {per_packet}"
    if not 0 < data.fps <= 100:
        return f"{data.fps} rotations/s"
    if not all(0 <= column < columns for column in data.column_window):
        return f"column_window {tuple(data.column_window)} with {columns} columns"
    if len(data.pixel_shift_by_row) != beams or np.abs(data.pixel_shift_by_row).max() >= columns:
        return f"pixel_shift_by_row does not fit {beams} beams x {columns} columns"
    return _angle_fault(info, beams) or _transform_fault(info)


def _angle_fault(info: core.SensorInfo, beams: int) -> str | None:
    altitude, azimuth = np.asarray(info.beam_altitude_angles), np.asarray(info.beam_azimuth_angles)
    if len(altitude) != beams or len(azimuth) != beams:
        return f"{len(altitude)} altitude and {len(azimuth)} azimuth angles for {beams} beams"
    if not (np.abs(altitude) <= 90).all() or not (np.abs(azimuth) <= 360).all():
        return "beam angles out of range"
    if beams > 1 and np.ptp(altitude) == 0:
        return f"all {beams} beams have the same altitude angle ({altitude[0]:g} deg)"
    return None


def _transform_fault(info: core.SensorInfo) -> str | None:
    for name in ("beam_to_lidar_transform", "lidar_to_sensor_transform"):
        transform = np.asarray(getattr(info, name))
        rotation = transform[:3, :3]
        rigid = (np.abs(transform) <= MAX_COORDINATE_MM).all()
        rigid = rigid and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        if not rigid or np.linalg.det(rotation) < 0:
            return f"{name} is not a rigid transform"
    return None


def _replaced_entry(document: dict, info: core.SensorInfo) -> str | None:
    """An entry that is there, but wrong in a way for which the SDK puts its own default in silence."""
    stated = dict(document)
    for section in ("beam_intrinsics", "lidar_intrinsics", *FORMAT_SECTIONS):
        if isinstance(document.get(section), dict):
            stated |= document[section]
    for holder, names in ((info, STATED_GEOMETRY), (info.format, STATED_FORMAT)):
        for name in names:
            used = np.ravel(getattr(holder, name))
            if name in stated and not np.array_equal(np.ravel(stated[name]), used):
                return f"{name} is {str(stated[name])[:60]}"
    return None


def _one_line(error: Exception) -> str:
    """The SDK's message without its headline and line breaks."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return "; ".join(line for line in lines if not line.startswith("ERROR: Critical"))[:MAX_TEXT]
