"""Recorded packets become the frames that were measured, and nothing is lost without being counted."""

import hashlib
import json
import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from captures import (
    COLUMNS,
    HOST_NS,
    IMU_PORT,
    PERIOD_NS,
    SERIAL,
    START_NS,
    Pcap,
    metadata,
    packets,
    ranges_mm,
    write_capture,
)
from ouster.sdk import core, osf

from revisitd.drivers.beside import match_metadata
from revisitd.drivers.datagrams import Reassembler
from revisitd.drivers.frame import Frame
from revisitd.drivers.losses import Loss
from revisitd.drivers.ouster import open_source, sensor_from_metadata
from revisitd.drivers.packets import FrameAssembler
from revisitd.drivers.pcap import PcapFile

PER_FRAME = COLUMNS // 16
PROFILES = ("RNG19_RFL8_SIG16_NIR16", "RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16_DUAL", "LEGACY")


def read(path: Path, meta: Path | None = None) -> tuple[list[Frame], Counter]:
    with open_source(str(path), meta) as source:
        return list(source), source.losses


@pytest.mark.parametrize("profile", PROFILES)
def test_frames_are_those_that_were_sent(tmp_path, profile):
    document = metadata(profile)
    path = write_capture(tmp_path, document, packets(document, range(3)))
    with open_source(str(path)) as source:
        assert source.n_frames_estimate == 3
        assert source.sensor.profile == profile
        frames = list(source)
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.range_mm, ranges_mm(index))
        assert frame.range_mm.dtype == np.uint32 and frame.reflectivity.dtype == np.uint8
        assert (frame.reflectivity == index + 1).all()
        assert frame.column_valid.all() and frame.valid_ratio == 1
        assert frame.column_ns[0] == START_NS + index * PERIOD_NS
        assert frame.stamp_ns == frame.column_ns[-1]
        assert HOST_NS <= frame.host_ns < HOST_NS + 10**9
    assert not source.losses


def test_points_and_rows_are_where_the_sensors_maker_puts_them():
    text = json.dumps(metadata())
    sensor, info = sensor_from_metadata(text), core.SensorInfo(text)
    image = ranges_mm(0) + 1
    expected = core.XYZLut(info, use_extrinsics=False)(image)
    np.testing.assert_allclose(sensor.points(image), expected, atol=1e-4)
    np.testing.assert_array_equal(sensor.destagger(image), core.destagger(info, image))
    np.testing.assert_allclose(np.linalg.norm(sensor.direction, axis=-1), 1, atol=1e-6)


def test_equal_geometry_has_an_equal_digest_and_other_geometry_another():
    sensor = sensor_from_metadata(json.dumps(metadata()))
    restarted = sensor_from_metadata(json.dumps(metadata(sensor_info__initialization_id=5)))
    angles = [21.0, *metadata()["beam_intrinsics"]["beam_altitude_angles"][1:]]
    other = sensor_from_metadata(json.dumps(metadata(beam_intrinsics__beam_altitude_angles=angles)))
    assert sensor.digest == restarted.digest != other.digest
    assert len(sensor.digest) == 16


def test_a_lost_packet_leaves_its_columns_invalid_and_empty(tmp_path):
    document = metadata()
    sent = packets(document, range(3))
    del sent[PER_FRAME + 3]
    frames, _ = read(write_capture(tmp_path, document, sent))
    assert [frame.valid_ratio for frame in frames] == [1, 1 - 16 / COLUMNS, 1]
    lost = slice(48, 64)
    assert not frames[1].column_valid[lost].any() and not frames[1].column_ns[lost].any()
    assert not frames[1].range_mm[:, lost].any()
    assert frames[1].stamp_ns == START_NS + PERIOD_NS + (COLUMNS - 1) * (PERIOD_NS // COLUMNS)


def test_a_packet_with_a_wrong_checksum_is_left_out_and_counted(tmp_path):
    document = metadata()
    sent = packets(document, range(2))
    damaged = bytearray(sent[40])
    damaged[1000] ^= 0x55
    frames, losses = read(write_capture(tmp_path, document, [*sent[:40], bytes(damaged), *sent[41:]]))
    assert losses == {Loss.BAD_CHECKSUM: 1}
    assert frames[1].valid_ratio == 1 - 16 / COLUMNS


def test_a_sensor_that_fills_in_no_checksum_is_read(tmp_path):
    document = metadata()
    sent = [payload[:-8] + bytes(8) for payload in packets(document, range(3))]
    frames, losses = read(write_capture(tmp_path, document, sent))
    assert [frame.valid_ratio for frame in frames] == [1, 1, 1] and not losses


def test_everything_that_is_not_a_lidar_packet_of_this_sensor_is_counted_by_cause(tmp_path):
    document = metadata()
    (tmp_path / "walk.json").write_text(json.dumps(document))
    other = packets(metadata(sensor_info__prod_sn="122300009999"), range(1))
    before = packets(metadata(sensor_info__initialization_id=7), range(1))
    pcap = Pcap().add_all(other).add_all(before[:5])
    pcap.add(bytes(48), port=IMU_PORT).add(bytes(500), port=9999).add(bytes(500))
    pcap.add_all(packets(document, range(1)))
    frames, losses = read(pcap.write(tmp_path / "walk.pcap"))
    assert len(frames) == 1 and frames[0].valid_ratio == 1
    assert losses == {
        Loss.OTHER_SENSOR: PER_FRAME,
        Loss.OTHER_INIT_ID: 5,
        Loss.IMU_PACKET: 1,
        Loss.OTHER_PORT: 1,
        Loss.WRONG_SIZE: 1,
    }


def test_a_lost_fragment_costs_its_packet_and_no_other(tmp_path):
    document = metadata()
    (tmp_path / "walk.json").write_text(json.dumps(document))
    pcap = Pcap().add_all(packets(document, range(2)))
    del pcap.records[7]
    frames, losses = read(pcap.write(tmp_path / "walk.pcap"))
    assert [frame.valid_ratio for frame in frames] == [1 - 16 / COLUMNS, 1]
    assert losses == {Loss.LOST_FRAGMENT: 1}


def test_frame_ids_that_begin_again_are_read_again(tmp_path):
    document = metadata()
    sent = packets(document, range(3)) + packets(document, range(3, 6), id_of=lambda index: index - 3)
    frames, losses = read(write_capture(tmp_path, document, sent))
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 0, 1, 2]
    assert all(frame.valid_ratio == 1 for frame in frames)
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.range_mm, ranges_mm(index))
    assert losses == {Loss.RESTARTED: 1}


def test_frame_ids_count_round(tmp_path):
    document = metadata()
    sent = packets(document, range(4), id_of=lambda index: (65534 + index) % 65536)
    frames, losses = read(write_capture(tmp_path, document, sent))
    assert [frame.frame_id for frame in frames] == [65534, 65535, 0, 1] and not losses


def test_packets_that_swapped_places_are_put_back(tmp_path):
    document = metadata()
    sent = packets(document, range(3))
    sent[PER_FRAME - 1], sent[PER_FRAME + 1] = sent[PER_FRAME + 1], sent[PER_FRAME - 1]
    frames, losses = read(write_capture(tmp_path, document, sent))
    assert [frame.valid_ratio for frame in frames] == [1, 1, 1] and not losses


def test_a_sensor_with_an_azimuth_window_has_whole_frames(tmp_path):
    document = metadata(lidar_data_format__column_window=[400, 99])
    sensor = sensor_from_metadata(json.dumps(document))
    window = np.flatnonzero(sensor.in_window)
    assert list(window[[0, 99, 100, -1]]) == [0, 99, 400, 511]
    sent = [p for p in packets(document, range(2)) if _first_column(p) < 100 or _first_column(p) >= 400]
    frames, losses = read(write_capture(tmp_path, document, sent))
    assert [frame.valid_ratio for frame in frames] == [1, 1] and not losses


def _first_column(payload: bytes) -> int:
    return struct.unpack_from("<H", payload, 32 + 8)[0]


def test_a_pcapng_file_is_read_like_a_pcap(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(2)))
    with PcapFile(path, Counter()) as file:
        records = list(file)
    blocks = [_block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))]
    blocks.append(_block(1, struct.pack("<HHI", 1, 0, 0) + struct.pack("<HHB3x", 9, 1, 9)))  # nanoseconds
    for record in records:
        size = len(record.data)
        times = struct.pack("<III", 0, record.time_ns >> 32, record.time_ns & 0xFFFFFFFF)
        blocks.append(_block(6, times + struct.pack("<II", size, size) + record.data + bytes(-size % 4)))
    other = tmp_path / "walk.pcapng"
    other.write_bytes(b"".join(blocks))
    frames, losses = read(other)
    assert [frame.host_ns for frame in frames] == [frame.host_ns for frame in read(path)[0]]
    np.testing.assert_array_equal(frames[1].range_mm, ranges_mm(1))
    assert not losses


def _block(kind: int, body: bytes) -> bytes:
    length = struct.pack("<I", len(body) + 12)
    return struct.pack("<I", kind) + length + body + length


def test_an_osf_file_holds_the_same_frames_as_the_packets_it_was_made_of(tmp_path):
    document = metadata()
    frames, _ = read(write_capture(tmp_path, document, packets(document, range(3))))
    info = core.SensorInfo(json.dumps(document))
    path = tmp_path / "walk.osf"
    with osf.Writer(str(path), info) as writer:
        assembler = FrameAssembler(info, Counter(), ("RANGE", "REFLECTIVITY", "FLAGS"))
        for payload in packets(document, range(3)):
            for lidar_frame in assembler.add(assembler.packet(payload, HOST_NS)):
                writer.save(0, lidar_frame)
    with open_source(str(path)) as source:
        assert source.n_frames_estimate == 3 and source.sensor.serial == str(SERIAL)
        for from_packets, from_osf in zip(frames, source, strict=True):
            np.testing.assert_array_equal(from_osf.range_mm, from_packets.range_mm)
            np.testing.assert_array_equal(from_osf.reflectivity, from_packets.reflectivity)
            np.testing.assert_array_equal(from_osf.column_ns, from_packets.column_ns)
            assert from_osf.frame_id == from_packets.frame_id
            assert from_osf.sensor.digest == from_packets.sensor.digest


def test_metadata_named_like_the_capture_is_found_beside_it(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(1)))
    (tmp_path / "walk.json").rename(tmp_path / "walk_0.json")
    (tmp_path / "other.json").write_text(json.dumps(metadata(sensor_info__prod_sn="122300009999")))
    (tmp_path / "walk_notes.json").write_text('{"weather": "rain"}')
    frames, _ = read(path)
    assert frames[0].sensor.serial == str(SERIAL)


DIGESTED = (
    "OS-0-128-U1_v2.3.0_1024x10",
    "OS-0-32-U1_v2.2.0_1024x10",
    "OS-1-32-G_v2.1.1_1024x10",
    "OS-2-128-U1_v2.3.0_1024x10",
    "OS-2-32-U0_v2.0.0_1024x10",
)


@pytest.mark.parametrize("name", DIGESTED)
def test_real_captures_decode_to_their_makers_digests(shared_data, name):
    path = shared_data / "ouster" / "pcaps" / f"{name}.pcap"
    stored = json.loads(path.with_name(f"{name}_digest.json").read_text())
    expected = stored.get("frames") or stored["scans"]
    frames = _sdk_frames(path)
    assert len(frames) == len(expected)
    for frame, digests in zip(frames, expected, strict=True):
        digests.pop("ENCODER_COUNT")  # no longer decoded by the SDK
        assert {key: _digests(frame)[key] for key in digests} == digests


def _sdk_frames(path: Path) -> list[core.LidarFrame]:
    """Every field of every frame, by the way that PcapSource goes."""
    meta, _, verdict = match_metadata(path, None)
    assembler = FrameAssembler(
        meta.info, Counter(), tuple(kind.name for kind in core.get_field_types(meta.info))
    )
    frames = []
    with PcapFile(path, Counter()) as file:
        for datagram in Reassembler(Counter()).datagrams(file):
            if not verdict.filter.fault(datagram.payload, datagram.port):
                frames += assembler.add(assembler.packet(datagram.payload, datagram.time_ns))
    return frames + list(assembler.flush())


def _digests(frame: core.LidarFrame) -> dict[str, str]:
    images = {name: frame.field(name) for name in frame.fields}
    images["TIMESTAMP"] = frame.timestamp.astype(np.uint64)
    images["STATUS"] = frame.status.astype(np.uint64)
    images["MEASUREMENT_ID"] = frame.measurement_id.astype(np.uint16)
    digests = {name: hashlib.md5(image.tobytes()).hexdigest() for name, image in images.items()}
    return digests | {"FRAME_ID": str(frame.frame_id)}


REAL = {
    "OS-1-128_v2.3.0_1024x10_lb_n3": (3, 1.0),
    "osf_fw_3.2_10scans": (10, 1.0),
    "OS-1-128_767798045_1024x10_20230712_120049": (1, 0.125),  # FUSA, dual return, an eighth of a turn
    "windowed_frame1": (1, 1.0),
    "windowed_frame2": (1, 1.0),  # a window that wraps
    "shot_limiting_test": (1, 16 / 1024),
    "duplicate_id": (1, 16 / 1024),  # a stray fragment with the identity of a whole packet
}


@pytest.mark.parametrize("name", REAL)
def test_real_captures_are_read_with_the_metadata_beside_them(shared_data, name):
    frames, _ = read(shared_data / "ouster" / "pcaps" / f"{name}.pcap")
    count, ratio = REAL[name]
    assert [frame.valid_ratio for frame in frames] == [pytest.approx(ratio)] * count


@pytest.mark.parametrize("sensor, beams", [("1", 128), ("2", 64)])
def test_two_sensors_at_one_port_are_told_apart_by_the_metadata(shared_data, sensor, beams):
    folder = shared_data / "ouster" / "pcaps"
    meta = folder / f"same_ports_nonlegacy.{sensor}.json"
    frames, losses = read(folder / "same_ports_nonlegacy.pcap", meta)
    assert [frame.sensor.shape[0] for frame in frames] == [beams]
    assert losses[Loss.OTHER_SENSOR] == 1


def test_a_real_osf_recording_equals_its_pcap(shared_data):
    from_osf, _ = read(shared_data / "ouster" / "osf" / "osf_fw_3.2_10scans.osf")
    from_pcap, _ = read(shared_data / "ouster" / "pcaps" / "osf_fw_3.2_10scans.pcap")
    assert len(from_osf) == len(from_pcap) == 10
    for a, b in zip(from_osf, from_pcap, strict=True):
        np.testing.assert_array_equal(a.range_mm, b.range_mm)
        np.testing.assert_array_equal(a.column_ns, b.column_ns)
