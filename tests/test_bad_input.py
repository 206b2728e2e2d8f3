"""Input that cannot be used ends with one line that says what is wrong, what was seen and what to do."""

import json
import struct
import zlib
from pathlib import Path

import pytest
from captures import (
    COLUMNS,
    IMU_PORT,
    INIT_ID,
    SERIAL,
    Pcap,
    metadata,
    packets,
    ranges_mm,
    write_capture,
)

from revisitd.drivers.errors import BadCapture, BadMetadata, DriverError, SourceNotFound
from revisitd.drivers.gate import FrameGate
from revisitd.drivers.losses import Loss
from revisitd.drivers.ouster import open_source, sensor_from_metadata


def complaint(path: Path, meta: Path | None = None) -> DriverError:
    """What is raised when the source is read to its end and judged."""
    with pytest.raises(DriverError) as caught, open_source(str(path), meta) as source:
        gate = FrameGate()
        for frame in source:
            gate.check(frame)
        gate.require_accepted(str(path))
    message = str(caught.value)
    assert "\n" not in message and len(message) < 800
    return caught.value


def assert_complaint(error: DriverError, kind: type[DriverError], *parts: str) -> None:
    assert type(error) is kind, error
    for part in parts:
        assert part in str(error)


@pytest.fixture(autouse=True)
def nothing_is_printed(capfd):
    yield
    assert capfd.readouterr() == ("", "")


def test_a_missing_file_and_a_folder_are_not_taken_for_a_sensor(tmp_path):
    assert_complaint(complaint(tmp_path / "walk.pcap"), SourceNotFound, "no file", "walk.pcap")
    assert_complaint(complaint(tmp_path), SourceNotFound, "is a folder")


@pytest.mark.parametrize(
    "content, part",
    [
        (b"", "is empty (0 bytes)"),
        (b"\xd4\xc3\xb2\xa1\x02\x00", "ends within its file header (6 of 24 bytes)"),
        (b"<html><body>404</body></html>", "is not a pcap or pcapng file (it begins with 3c68746d)"),
    ],
)
def test_a_file_that_is_no_capture_is_named_as_such(tmp_path, content, part):
    path = write_capture(tmp_path, metadata(), [])
    path.write_bytes(content)
    assert_complaint(complaint(path), BadCapture, part)


def test_a_capture_without_packets_is_an_error(tmp_path):
    path = write_capture(tmp_path, metadata(), [])
    assert_complaint(complaint(path), BadCapture, "(24 bytes)", "no packets")


def test_a_capture_of_other_traffic_is_an_error(tmp_path):
    path = write_capture(tmp_path, metadata(), [])
    pcap = Pcap()
    pcap.records = [b"\0" * 12 + b"\x08\x06" + bytes(28)] * 3  # ARP
    pcap.write(path)
    assert_complaint(complaint(path), BadCapture, "3 network packets", "no whole UDP packet", "3 not UDP")


def test_packets_cut_by_the_recorders_snap_length_are_named(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(1)))
    data = bytearray(path.read_bytes()[:24])
    for _ in range(5):
        data += struct.pack("<IIII", 0, 0, 96, 1514) + bytes(96)
    path.write_bytes(data)
    assert_complaint(complaint(path), BadCapture, "no whole UDP packet", "5 cut record")


def test_a_part_of_a_turn_is_not_a_frame(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(1))[:1])
    assert_complaint(
        complaint(path), BadCapture, "no whole frame", "1 too few columns", f"{COLUMNS - 16} columns missing"
    )


def test_a_truncated_record_costs_the_packet_it_belongs_to(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(3)))
    path.write_bytes(path.read_bytes()[:-700])
    with open_source(str(path)) as source:
        frames = list(source)
        assert [frame.valid_ratio for frame in frames] == [1, 1, 1 - 16 / COLUMNS]
        assert source.losses == {Loss.TRUNCATED_RECORD: 1, Loss.LOST_FRAGMENT: 1}
    assert (frames[1].range_mm == ranges_mm(1)).all()


def test_a_record_of_impossible_length_ends_the_reading(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(3)))
    data = bytearray(path.read_bytes())
    at = 24
    for _ in range(7):
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    struct.pack_into("<I", data, at + 8, 2**31)
    path.write_bytes(data)
    with open_source(str(path)) as source:
        assert [frame.valid_ratio for frame in source] == [16 / COLUMNS]  # 5 records a packet
        assert source.losses == {Loss.DAMAGED_RECORD: 1, Loss.LOST_FRAGMENT: 1}


def test_metadata_that_is_nowhere_is_asked_for(tmp_path):
    document = metadata()
    path = write_capture(tmp_path, document, packets(document, range(1)))
    (tmp_path / "walk.json").unlink()
    seen = "32 of 6400 bytes to port 7502 from 10.5.5.9"
    assert_complaint(complaint(path), SourceNotFound, "walk.json", "--meta", seen)
    assert_complaint(complaint(path, tmp_path / "no.json"), SourceNotFound, "no.json", "No such file")


@pytest.mark.parametrize(
    "changes, parts",
    [
        ({"config_params__udp_port_lidar": 7777}, ["udp_port_lidar 7777", "go to port 7502"]),
        ({"sensor_info__initialization_id": 5}, ["init id 5", f"at init id {INIT_ID}", "restarted"]),
        ({"sensor_info__prod_sn": "122300009999"}, ["sensor 122300009999", f"from sensor {SERIAL}"]),
        ({"profile": "RNG15_RFL8_NIR8"}, ["packets of", "RNG15_RFL8_NIR8, 32 beams", "seen 32 UDP packets"]),
    ],
)
def test_metadata_of_another_recording_is_not_used(tmp_path, changes, parts):
    document = metadata()
    path = write_capture(tmp_path, metadata(**changes), packets(document, range(1)))
    assert_complaint(complaint(path), BadMetadata, "walk.json", *parts)


def test_metadata_of_another_lidar_mode_is_noticed_though_legacy_packets_carry_no_ids(tmp_path):
    document = metadata("LEGACY")
    other = metadata(
        "LEGACY",
        lidar_data_format__columns_per_frame=256,
        lidar_data_format__column_window=[0, 255],
    )
    path = write_capture(tmp_path, other, packets(document, range(1)))
    assert_complaint(complaint(path), BadMetadata, "256 columns a turn")


def test_legacy_packets_of_two_like_sensors_are_not_mixed(tmp_path):
    document = metadata("LEGACY")
    path = write_capture(tmp_path, document, [])
    pcap = Pcap()
    for payload in packets(document, range(2)):
        pcap.add(payload).add(payload, source=bytes([10, 5, 5, 10]))
    pcap.write(path)
    assert_complaint(complaint(path), BadCapture, "10.5.5.9", "10.5.5.10", "cannot be told apart")


def test_unrelated_metadata_is_not_guessed_for_legacy_packets(tmp_path):
    document = metadata("LEGACY")
    path = write_capture(tmp_path, document, packets(document, range(1)))
    (tmp_path / "walk.json").rename(tmp_path / "hall.json")
    assert_complaint(complaint(path), SourceNotFound, "hall.json may be it", "no serial")


def test_a_capture_that_fits_several_metadata_files_is_not_guessed(tmp_path):
    document, other = metadata(), metadata(sensor_info__prod_sn="122300009999")
    path = write_capture(tmp_path, document, packets(document, range(1)) + packets(other, range(1)))
    (tmp_path / "walk.json").rename(tmp_path / "walk_1.json")
    (tmp_path / "walk_2.json").write_text(json.dumps(other))
    assert_complaint(complaint(path), BadMetadata, "walk_1.json, walk_2.json", "--meta")


def test_a_lidar_that_was_off_is_named(tmp_path):
    path = write_capture(tmp_path, metadata(), [])
    Pcap().add_all([bytes(48)] * 4, port=IMU_PORT).write(path)
    assert_complaint(complaint(path), BadCapture, "the lidar was off", "4 of 48 bytes to port 7503")


@pytest.mark.parametrize(
    "change, part",
    [
        ({"lidar_data_format__udp_profile_lidar": "OFF"}, "switched off"),
        ({"beam_intrinsics__beam_altitude_angles": [0] * 32}, "same altitude angle"),
        ({"beam_intrinsics__beam_altitude_angles": [1, 2, 3]}, "beam_altitude_angles"),
        ({"lidar_data_format__pixel_shift_by_row": [0] * 5}, "pixel_shift_by_row"),
        ({"lidar_data_format__columns_per_frame": 10**9}, "columns"),
        ({"lidar_data_format__pixels_per_column": 2**31}, "pixels_per_column is 2147483648"),
        ({"lidar_data_format__pixels_per_column": -1}, "pixels_per_column is -1"),
        ({"lidar_data_format__column_window": [0, 5000]}, "column_window"),
        ({"lidar_intrinsics__lidar_to_sensor_transform": [0] * 16}, "lidar_to_sensor_transform"),
        ({"sensor_info__prod_line": "x" * 100_000}, "too long"),
    ],
)
def test_unusable_metadata_is_refused_with_the_entry_that_is_wrong(change, part):
    with pytest.raises(BadMetadata) as caught:
        sensor_from_metadata(json.dumps(metadata(**change)))
    assert part in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "{}", '{"a": ' * 5000, '{"lidar_mode": "1024x10"}'])
def test_metadata_that_is_none_is_refused(text):
    with pytest.raises(BadMetadata) as caught:
        sensor_from_metadata(text)
    assert "\n" not in str(caught.value)


WILD_HEADER = b"\x34\0\0\0" + b"\xff" * 52  # it points beyond itself, though its checksum is right


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"hello",
        bytes(200),
        b"\x34\0\0\0" + bytes(60),
        WILD_HEADER + zlib.crc32(WILD_HEADER).to_bytes(4, "little"),
    ],
)
def test_a_broken_osf_file_is_an_error(tmp_path, content):
    path = tmp_path / "walk.osf"
    path.write_bytes(content)
    assert_complaint(complaint(path), BadCapture, "walk.osf", "is damaged")


REAL_CAPTURES = {
    "OS-0-128_v3.0.1_1024x10": (BadCapture, "is empty (0 bytes)"),
    "OS-0-128_v3.0.1_1024x10_20240321_125947": (BadCapture, "is empty (0 bytes)"),
    "empty_pcap": (BadCapture, "no packets at all"),
    "OS-0-32-U1_v2.2.0_1024x10-single-packet": (BadCapture, "1 too few columns; 1008 columns missing"),
    "VLI-16-one-packet": (BadCapture, "no lidar packets of an Ouster sensor: seen 1 UDP packet: 1 of 1212"),
    "imu_zm_no_lidar": (BadMetadata, "lidar is switched off"),
    "duplicate_id": (BadCapture, "no whole frame"),
    "shot_limiting_test": (BadCapture, "no whole frame"),
    "OS-1-64_1024x10_fw20": (SourceNotFound, "OS-1-64_sensor_config_reduced.json"),
    "same_ports": (BadMetadata, "fits several metadata files"),
    "same_ports_legacy": (BadMetadata, "fits several metadata files"),
    "same_ports_nonlegacy": (BadMetadata, "fits several metadata files"),
}


@pytest.mark.parametrize("name", REAL_CAPTURES)
def test_real_captures_without_a_frame_say_why(shared_data, name):
    kind, part = REAL_CAPTURES[name]
    assert_complaint(complaint(shared_data / "ouster" / "pcaps" / f"{name}.pcap"), kind, part)


def test_another_makers_packets_are_not_read_with_an_ousters_metadata(shared_data):
    folder = shared_data / "ouster" / "pcaps"
    error = complaint(folder / "VLI-16-one-packet.pcap", folder / "OS-1-128_v2.3.0_1024x10.json")
    assert_complaint(error, BadCapture, "no lidar packets at port 7502", "1212 bytes to port 2368")


MALFORMED = {
    "complete_but_all_zeros_legacy": "same altitude angle",
    "garbled_legacy_and_nonlegacy": "config_params",
    "incomplete_no_calref_nonlegacy": "calibration_status",
    "incomplete_no_sensor_info_nonlegacy": "sensor_info",
    "incorrect_nbeam_angles_legacy_113": "beam_altitude_angles",
    "legacy_with_calibration_status": "beam_intrinsics",
}
DEDUCIBLE = ("incomplete_data_format_legacy", "incomplete_data_format_nonlegacy")


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_metadata_of_real_sensors_is_refused(shared_data, name):
    path = shared_data / "ouster" / "metadata" / "malformed" / f"{name}.json"
    with pytest.raises(BadMetadata) as caught:
        sensor_from_metadata(path.read_text())
    assert MALFORMED[name] in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", DEDUCIBLE)
def test_a_missing_entry_that_the_others_determine_is_filled_in(shared_data, name):
    path = shared_data / "ouster" / "metadata" / "malformed" / f"{name}.json"
    sensor = sensor_from_metadata(path.read_text())
    assert sensor.shape == (128, 1024) and sensor.mode == "1024x10"


@pytest.mark.parametrize("name", ["bad_crc32", "bad_encoding", "empty_osf"])
def test_broken_osf_recordings_are_errors(shared_data, name):
    path = shared_data / "ouster" / "osf" / f"{name}.osf"
    assert_complaint(complaint(path), BadCapture, path.name, "no frame")


def test_an_osf_recording_with_a_damaged_byte_or_a_missing_end_is_an_error(shared_data, tmp_path):
    whole = (shared_data / "ouster" / "osf" / "osf_fw_3.2_10scans.osf").read_bytes()
    path = tmp_path / "walk.osf"
    for at in (40, len(whole) - 2000, 200_000):
        damaged = bytearray(whole)
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        assert_complaint(complaint(path), BadCapture, "walk.osf")
    path.write_bytes(whole[:300_000])
    assert_complaint(complaint(path), BadCapture, "holds no frames", "it was cut")
    cut = bytearray(whole[:300_000])
    cut[500] ^= 0xFF
    path.write_bytes(cut)
    assert_complaint(complaint(path), BadCapture, "its end is missing", "wrong checksum")
