"""The emulator is a sensor to the live source and to the official SDK, and the live source survives its faults."""

import json
import os
import socket
import subprocess
import sys
from contextlib import closing
from urllib.error import HTTPError

import numpy as np
import pytest
from captures import IMU_PORT, PERIOD_NS, Pcap, metadata, packets, ranges_mm
from click.testing import CliRunner
from emulated import emulated
from fake_sensor import free_port
from follower import Follower

from revisitd.daemon.cli import cli
from revisitd.drivers import faults, kept, sensor_setup
from revisitd.drivers.kept import Phase
from revisitd.drivers.losses import Loss
from revisitd.drivers.sensor_setup import SensorWish

N_FRAMES = 3


@pytest.fixture(scope="module")
def emulator(capture):
    with emulated(capture) as running:
        yield running


@pytest.fixture
def sensor(emulator):
    """One emulator for all tests, as new for each."""
    emulator.reset()
    return emulator


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """The emulator tells its new state at once, unlike a real sensor, and faults may come and go quickly."""
    monkeypatch.setattr(sensor_setup, "POLL_S", 0.02)
    monkeypatch.setattr(faults, "WINDOW_S", 0.3)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three rotations of an OS1-32, with IMU packets in between."""
    folder = tmp_path_factory.mktemp("capture")
    (folder / "walk.json").write_text(json.dumps(metadata()))
    pcap = Pcap()
    for number, payload in enumerate(packets(metadata(), range(N_FRAMES))):
        pcap.add(payload)
        if number % 8 == 7:
            pcap.add(np.array([0, 0, 0], "<u8").tobytes() + bytes(24), IMU_PORT)
    return pcap.write(folder / "walk.pcap")


@pytest.fixture
def follow():
    followers = []

    def begin(address: str, **wish) -> Follower:
        followers.append(Follower(address, SensorWish(**{"udp_port_lidar": free_port()} | wish)))
        return followers[-1]

    yield begin
    for follower in followers:
        follower.close()


def frame_ids(frames) -> list[int]:
    return [frame.frame_id for frame in frames]


def test_a_looped_capture_is_one_stream_whose_ids_and_times_go_on(sensor, follow):
    follower = follow(sensor.address)
    frames = follower.more_frames(9)[1:]  # the first one began before we listened
    first = frames[0].frame_id
    assert frame_ids(frames) == list(range(first, first + 8))
    assert np.diff([frame.stamp_ns for frame in frames]) == pytest.approx(PERIOD_NS, abs=PERIOD_NS / 1000)
    shown = [next(index for index in range(N_FRAMES) if (frame.range_mm == ranges_mm(index)).all()) for frame in frames]
    assert shown == [(shown[0] + number) % N_FRAMES for number in range(8)]
    assert not follower.source.losses[Loss.BAD_CHECKSUM]


def test_imu_packets_are_sent_and_taken_in_without_harm(sensor, follow):
    port = free_port()
    sensor.configure(udp_port_imu=port)
    follower = follow(sensor.address, udp_port_lidar=port)
    frames = follower.more_frames(4)
    assert follower.source.losses[Loss.IMU_PACKET] > 0
    assert all(frame.valid_ratio == 1 for frame in frames[1:])


def test_a_sensor_that_comes_late_is_opened_when_it_is_there(capture, follow):
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    follower = follow(f"127.0.0.1:{port}")
    follower.until_problem("no sensor answers")
    with emulated(capture, port=port):
        state = follower.until_running()
    assert state.problem == "" and state.n_opened == 1


def test_a_restart_is_followed_by_its_new_init_id_and_the_wish_is_set_again(sensor, follow):
    follower = follow(sensor.address, timestamp_mode="TIME_FROM_PTP_1588")
    before = follower.more_frames(1)[0]
    sensor.inject(reboot_s=0.3)
    follower.until_opened(2)
    after = follower.more_frames(2)[-1]
    assert sensor.get("sensor/config")["timestamp_mode"] == "TIME_FROM_PTP_1588"
    assert after.sensor.init_id > before.sensor.init_id


def test_after_a_restart_the_internal_clock_begins_anew(sensor, follow):
    follower = follow(sensor.address)
    before = follower.more_frames(4)[-1]
    sensor.inject(reboot_s=0.1)
    follower.until_opened(2)
    again = follower.more_frames(2)[-1]
    assert again.clock_offset_ns > before.clock_offset_ns + PERIOD_NS


def test_what_was_persisted_outlives_a_restart(capture, follow):
    with emulated(capture) as sensor:
        follower = follow(sensor.address, timestamp_mode="TIME_FROM_PTP_1588", persist=True)
        follower.until_running()
        sensor.inject(reboot_s=0.05)
        follower.until(lambda state: state.phase is not Phase.RUNNING)
        follower.until_running()
        assert follower.source.state.sensor.timestamp_mode == "TIME_FROM_PTP_1588"
        assert sensor.get("sensor/config")["udp_dest"] == "127.0.0.1"


def test_silence_is_named_and_over_with_the_first_packet(sensor, follow):
    follower = follow(sensor.address)
    last = follower.more_frames(2)[-1]
    sensor.inject(silence_s=1.0)
    assert follower.until_problem("sends nothing to UDP port").phase is Phase.SILENT
    state = follower.until_running()
    again = follower.more_frames(2)[-1]
    assert state.n_opened == 1 and state.problem == ""
    assert again.frame_id > last.frame_id + 5


def test_another_profile_and_mode_set_by_someone_else_are_followed(sensor, follow):
    follower = follow(sensor.address)
    follower.more_frames(1)
    sensor.configure(udp_profile_lidar="RNG15_RFL8_NIR8", lidar_mode="1024x10")
    follower.until_opened(2)
    frame = follower.more_frames(2)[-1]
    assert (frame.sensor.profile, frame.sensor.mode) == ("RNG15_RFL8_NIR8", "1024x10")
    # Twice as many columns: each of the recording is there twice.
    assert any((frame.range_mm == np.repeat(ranges_mm(index), 2, axis=1)).all() for index in range(N_FRAMES))


def test_another_mode_is_followed_where_packets_carry_no_ids(sensor, follow, monkeypatch):
    monkeypatch.setattr(kept, "RECHECK_S", 0.1)
    sensor.configure(udp_profile_lidar="LEGACY", lidar_mode="1024x10")
    follower = follow(sensor.address)
    follower.more_frames(2)
    sensor.configure(lidar_mode="512x10")  # the packets are as before, only fewer
    follower.until_opened(2)
    assert follower.more_frames(2)[-1].valid_ratio == 1


def test_what_is_wished_is_set_again_when_someone_else_changes_it(sensor, follow):
    follower = follow(sensor.address, udp_profile_lidar="RNG15_RFL8_NIR8", azimuth_window=(90_000, 270_000))
    frame = follower.more_frames(2)[-1]
    assert frame.sensor.profile == "RNG15_RFL8_NIR8"
    assert frame.sensor.column_window == (129, 384) and frame.valid_ratio == 1
    sensor.configure(udp_profile_lidar="LEGACY", azimuth_window=[0, 360_000])
    follower.until_opened(2)
    assert follower.more_frames(2)[-1].sensor.profile == "RNG15_RFL8_NIR8"


@pytest.mark.parametrize(
    "azimuth_window, columns",
    [([180_000, 360_000], [1, 256]), ([300_000, 100_000], [370, 85]), ([0, 360_000], [0, 511])],
)
def test_azimuth_windows_are_the_columns_that_real_sensors_tell(sensor, azimuth_window, columns):
    """As in the metadata of ouster-sdk's windowed captures, of sensors at 512x10."""
    sensor.configure(azimuth_window=azimuth_window)
    assert sensor.get("sensor/metadata/lidar_data_format")["column_window"] == columns


def test_a_stolen_stream_is_named_and_taken_back(sensor, follow):
    follower = follow(sensor.address)
    follower.more_frames(1)
    sensor.configure(udp_dest="10.5.5.77")
    state = follower.until_problem("udp_dest = '10.5.5.77'")
    assert state.phase is Phase.WAITING and "another client took its stream" in state.problem
    follower.until_running()


def test_a_setting_that_the_sensor_refuses_is_quoted(sensor, follow):
    follower = follow(sensor.address, lidar_mode="1024x20")
    state = follower.until_problem("refuses")
    assert "400" in state.problem and "the capture turns at 10 Hz" in state.problem


def test_checksum_failures_are_counted_and_named_and_go_away(sensor, follow):
    follower = follow(sensor.address)
    follower.more_frames(2)
    sensor.inject(corrupt=0.3)
    state = follower.until_problem("fail their checksum")
    assert state.phase is Phase.RUNNING and follower.source.losses[Loss.BAD_CHECKSUM] > 5
    sensor.inject(corrupt=0.0)
    follower.until(lambda state: state.problem == "")


def test_a_stream_of_nothing_but_damaged_packets_is_named_as_such(sensor, follow):
    follower = follow(sensor.address)
    follower.more_frames(2)
    sensor.inject(corrupt=1.0)
    follower.until(lambda state: state.phase is Phase.SILENT and "fail their checksum" in state.problem)
    sensor.inject(corrupt=0.0)
    follower.until(lambda state: state.phase is Phase.RUNNING and not state.problem)


def test_packets_of_another_sensor_are_left_out_and_named(capture, sensor, follow):
    with emulated(capture, "--serial", "999") as other:
        port = free_port()
        follower = follow(sensor.address, udp_port_lidar=port)
        follower.more_frames(1)
        other.configure(udp_dest="127.0.0.1", udp_port_lidar=port)
        follower.until_problem("packets of another sensor")
        assert follower.more_frames(2)[-1].valid_ratio == 1
        sensor.inject(silence_s=60)
        follower.until_problem("what comes is of another sensor")


@pytest.mark.parametrize(
    "fault, says",
    [("error", "answers 500"), ("garbage", "does not answer with JSON"), ("slow", "")],
)
def test_a_sensor_whose_http_fails_is_opened_once_it_answers(sensor, follow, fault, says):
    sensor.inject(http=fault)
    follower = follow(sensor.address)
    follower.until_problem(says)
    follower.until(lambda state: state.phase is Phase.CONNECTING)
    sensor.inject(http="none")
    follower.until_running()


def test_a_step_of_the_sensors_clock_shows_in_its_frames(sensor, follow):
    follower = follow(sensor.address)
    before = follower.more_frames(2)[-1]
    sensor.inject(step_s=-5.0)
    follower.until(lambda _: len(follower.frames) > 0 and follower.frames[-1].stamp_ns < before.stamp_ns)
    assert follower.frames[-1].frame_id > before.frame_id


def test_dropped_packets_are_lost_columns(sensor, follow):
    sensor.inject(drop=0.2)
    frames = follow(sensor.address).more_frames(6)
    assert 0.5 < np.mean([frame.valid_ratio for frame in frames]) < 0.95


def test_a_capture_that_is_not_looped_ends_the_program(capture, tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", "from revisitd.daemon.cli import main; main()", "emulate", str(capture)]
        + ["--http-port", "0", "--rate", "100"],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert result.returncode == 0 and result.stdout.startswith("sensor at 127.0.0.1:") and not result.stderr


def test_a_taken_port_is_one_clear_line(capture, sensor):
    port = sensor.address.rpartition(":")[2]
    result = CliRunner().invoke(cli, ["emulate", str(capture), "--http-port", port])
    assert result.exit_code == 69
    assert result.output == (
        f"Error: no sensor can be at http://127.0.0.1:{port} (Address already in use): "
        "give another --http-port or --host\n"
    )


def test_faults_that_do_not_exist_are_refused(sensor):
    for fault in ({"fire": 1.0}, {"drop": "all"}, {"http": "teapot"}):
        with pytest.raises(HTTPError, match="400"):
            sensor.inject(**fault)


def test_the_official_sdk_opens_it(sensor):
    """Through http_proxy, since the SDK knows no other port than 80; in a process of its own for that variable."""
    client = """
from ouster.sdk import open_source
source = open_source("127.0.0.1", lidar_port=PORT, imu_port=IMU, timeout=5.0)
frames = [frames[0] for frames, _ in zip(source, range(4))]
source.close()
print([frame.frame_id for frame in frames], frames[-1].complete())
""".replace("PORT", str(free_port())).replace("IMU", str(free_port()))
    environment = os.environ | {"http_proxy": f"http://{sensor.address}"}
    result = subprocess.run([sys.executable, "-c", client], env=environment, capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr
    ids = json.loads(result.stdout.strip().splitlines()[-1].rpartition("]")[0] + "]")
    assert ids == list(range(ids[0], ids[0] + 4)) and result.stdout.strip().endswith("True")
