"""A simulated capture: genuine packets that decode to what was measured, and a truth that fits them."""

import json

import numpy as np
import pytest

pytest.importorskip("revisitd.drivers.virtual.embree", reason="needs the extra [sim]", exc_type=ImportError)

from ouster.sdk import open_source

from revisitd.drivers.ouster import sensor_from_metadata
from revisitd.drivers.virtual import SCENARIOS, simulate
from revisitd.drivers.virtual.packets import BOOT_NS, PROFILES, Encoder
from revisitd.drivers.virtual.sensor import virtual_metadata
from revisitd.drivers.virtual.truth import thin
from revisitd.drivers.virtual.worlds import build_world

SECONDS = 0.8


def frames_of(capture):
    return [frame_set[0] for frame_set in open_source(str(capture.pcap), meta=[str(capture.metadata)])]


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("one"), "tiny", seed=5, beams=32, columns=512, max_s=SECONDS, workers=1)


@pytest.fixture(scope="module")
def patrol(tmp_path_factory):
    """A whole tiny patrol: capture, world."""
    path = tmp_path_factory.mktemp("patrol")
    return simulate(path, "tiny", seed=1, beams=32, columns=512), build_world(SCENARIOS["tiny"], 1)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("beams", [32, 128])
def test_packets_decode_to_the_frame_that_was_encoded(profile, beams):
    encoder = Encoder(virtual_metadata(beams, 512, profile=profile))
    rng = np.random.default_rng(1)
    shape = (beams, 512)
    fields = {
        "RANGE": rng.integers(400, 120_000, shape, np.uint32), "REFLECTIVITY": rng.integers(0, 255, shape, np.uint8),
        "SIGNAL": rng.integers(0, 9000, shape, np.uint16), "NEAR_IR": rng.integers(0, 4000, shape, np.uint16),
    }  # fmt: skip
    frame = encoder.frame(3, fields)
    assert np.abs(frame.field("RANGE").astype(int) - fields["RANGE"]).max() < 8  # RNG15 counts in 8 mm
    packets = encoder.packets(frame)
    assert all(packet.host_timestamp > 0 for packet in packets)
    from ouster.sdk.core import FrameBatcher, LidarFrame

    batcher, decoded = FrameBatcher(encoder.info), LidarFrame(encoder.info)
    for packet in packets:
        batcher.batch(packet, decoded)
    assert decoded.frame_id == 4
    for name in frame.fields:
        np.testing.assert_array_equal(decoded.field(name), frame.field(name), err_msg=name)
    for name in ("timestamp", "measurement_id", "status", "packet_timestamp"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(frame, name), err_msg=name)


def test_a_capture_reads_back_whole_with_its_clock_and_host_times(capture):
    frames = frames_of(capture)
    assert [frame.frame_id for frame in frames] == list(range(1, 9))
    assert all(frame.complete() for frame in frames)
    stamps = np.concatenate([frame.timestamp for frame in frames]).astype(np.int64)
    assert stamps[0] == BOOT_NS and np.diff(stamps).min() > 0
    host = np.concatenate([frame.packet_timestamp for frame in frames]).astype(np.int64)
    assert np.diff(host).min() > 0 and (host % 1000 == 0).all()


def test_the_same_seed_gives_the_same_bytes_with_any_number_of_processes(capture, tmp_path):
    again = simulate(tmp_path, "tiny", seed=5, beams=32, columns=512, max_s=SECONDS, workers=2)
    assert again.pcap.read_bytes() == capture.pcap.read_bytes()
    assert again.metadata.read_text() == capture.metadata.read_text()
    for name in ("poses.txt", "changes.json", "objects.json"):
        assert (again.truth / name).read_text() == (capture.truth / name).read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture.json", "capture.pcap", "truth"]


def test_labels_say_whose_each_return_is(capture):
    labels = np.load(capture.truth / "labels.npz")
    kinds = json.loads((capture.truth / "objects.json").read_text())
    for index, frame in enumerate(frames_of(capture)):
        number = labels[f"{index:06d}"]
        np.testing.assert_array_equal(number > 0, frame.field("RANGE") > 0)
        assert number.max() < len(kinds)


def test_truth_poses_are_those_at_the_frames_ends_in_the_map_frame(patrol):
    capture, world = patrol
    poses = np.loadtxt(capture.truth / "poses.txt")
    frames = frames_of(capture)
    assert len(poses) == len(frames)
    ends = np.array([int(frame.timestamp[-1]) for frame in frames])
    np.testing.assert_allclose(poses[:, 0], ends * 1e-9, atol=1e-6)
    np.testing.assert_allclose(poses[0, 1:], [0, 0, 0, 0, 0, 0, 1], atol=1e-9)
    T_world_sensor = world.patrol.pose((ends - BOOT_NS) * 1e-9)
    expected = np.linalg.inv(T_world_sensor[0]) @ T_world_sensor
    np.testing.assert_allclose(poses[:, 1:4], expected[:, :3, 3], atol=1e-5)


def test_change_points_lie_where_the_packets_put_the_change(patrol):
    capture, world = patrol
    changes = json.loads((capture.truth / "changes.json").read_text())
    assert {change["polarity"] for change in changes} == {"appeared", "disappeared"}
    sensor = sensor_from_metadata(capture.metadata.read_text())
    labels = np.load(capture.truth / "labels.npz")
    T_world_map = world.patrol.pose((Encoder(capture.metadata.read_text()).column_ns(0)[-1] - BOOT_NS) * 1e-9)
    for change in changes:
        found = []
        for index, frame in enumerate(frames_of(capture)):
            row, column = np.nonzero(labels[f"{index:06d}"] == change["object"])
            local = sensor.points(frame.field("RANGE"))[row, column]
            pose = np.linalg.inv(T_world_map) @ world.patrol.pose(
                (frame.timestamp[column].astype(int) - BOOT_NS) * 1e-9
            )
            found.append(np.einsum("kij,kj->ki", pose[:, :3, :3], local) + pose[:, :3, 3])
        found, points = np.concatenate(found), np.array(change["points"])
        assert change["n_visible_returns"] > 200 and len(points) > 50
        gap = np.linalg.norm(thin(found, 0.1).mean(0) - points.mean(0))
        assert gap < 0.25
        assert np.mean(change["confirmable"]) > 0.5


def test_labels_of_a_change_occur_exactly_in_its_passes(patrol):
    capture, world = patrol
    labels = np.load(capture.truth / "labels.npz")
    for change in json.loads((capture.truth / "changes.json").read_text()):
        item = world.items[change["object"] - 1]
        for index in range(len(labels.files)):
            if (labels[f"{index:06d}"] == change["object"]).any():
                assert item.is_there(world.patrol.pass_at(index * 0.1))


def test_unknown_names_are_refused_with_those_known(tmp_path):
    with pytest.raises(ValueError, match="unknown scenario 'nowhere'; known: tiny"):
        simulate(tmp_path, "nowhere")
    with pytest.raises(ValueError, match="unknown profile"):
        simulate(tmp_path, "tiny", profile="RNG99")


def test_a_process_that_fails_ends_the_simulation_with_its_error(tmp_path):
    from dataclasses import replace

    full = replace(SCENARIOS["tiny"], name="crowded", staged=SCENARIOS["tiny"].staged * 400)
    with pytest.raises(ValueError, match="no room"):
        simulate(tmp_path, full, beams=32, columns=512)
