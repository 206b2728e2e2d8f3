"""A sensor is kept open through all that it and the network do, and what is wrong is stated."""

import socket
import threading
import time
from contextlib import contextmanager

import pytest
from captures import metadata, packets, ranges_mm
from fake_sensor import fake_sensor, free_port
from follower import Follower

from revisitd.drivers import kept, sensor_setup, strangers
from revisitd.drivers.kept import KeptSource, Phase
from revisitd.drivers.sensor_setup import SensorWish


@pytest.fixture(autouse=True)
def impatience(monkeypatch):
    """The fake sensor tells its new state at once, unlike a real one."""
    monkeypatch.setattr(sensor_setup, "POLL_S", 0.02)


@pytest.fixture
def follow(caplog):
    followers = []

    def begin(address: str, **wish) -> Follower:
        followers.append(Follower(address, SensorWish(**wish)))
        return followers[-1]

    yield begin
    caplog.clear()
    for follower in followers:
        follower.close()
    assert not caplog.records, "to be stopped is no problem"


def test_a_sensor_that_is_absent_at_first_is_waited_for(follow):
    with fake_sensor() as gone:
        address = gone.address
    follower = follow(address)
    state = follower.until_problem("no sensor answers")
    assert state.phase is Phase.WAITING and state.sensor is None and state.n_opened == 0
    for phase in (Phase.CONNECTING, Phase.WAITING, Phase.CONNECTING, Phase.WAITING):
        again = follower.until(lambda state, phase=phase: state.phase is phase)
        assert (again.problem, again.since_ns) == (state.problem, state.since_ns), "each attempt is no news"


def test_frames_come_as_they_are_sent_and_the_state_says_so(follow):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        fake.send(packets(fake.document, range(2)))
        state = follower.until_running()
        assert state.problem == "" and state.sensor.mode == "512x10"
        assert (follower.frames[0].range_mm == ranges_mm(0)).all()


def test_a_restarted_sensor_is_opened_again_with_its_new_metadata(follow):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        fake.send(packets(fake.document, range(1)))
        first = follower.until_running().sensor
        fake.document["sensor_info"]["initialization_id"] += 1
        follower.until_problem("was restarted or reconfigured")
        follower.until_opened(2)
        fake.send(packets(fake.document, range(1)))
        assert follower.until_running().sensor.init_id == first.init_id + 1


def test_a_stream_that_another_client_took_is_named_and_taken_back(follow):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        fake.document["config_params"]["udp_dest"] = "10.5.5.77"
        state = follower.until_problem("now has udp_dest = '10.5.5.77'")
        assert "another client took its stream" in state.problem
        follower.until_opened(2)
        assert fake.document["config_params"]["udp_dest"] == "127.0.0.1"


@pytest.mark.parametrize(
    "section, name, values, delays",
    [
        ("config_params", "udp_dest", ["10.5.5.77"] * 2, [0.05, 0.1]),  # two clients must not fight each second
        ("sensor_info", "initialization_id", [1, 2], [0.05, 0.05]),
    ],
)
def test_what_another_client_takes_is_taken_back_less_and_less_often_and_all_else_at_once(
    follow, monkeypatch, section, name, values, delays
):
    waited = []
    monkeypatch.setattr(KeptSource, "_wait", lambda _self, delay_s: waited.append(delay_s) or iter([None]))
    with fake_sensor() as fake:
        follower = follow(fake.address)
        for times, value in enumerate(values, 1):
            follower.until_opened(times)
            fake.send(packets(fake.document, range(1)))
            follower.until_running()
            fake.document[section][name] = value
            follower.until(lambda _, times=times: len(waited) == times)
    assert waited == delays


def test_a_silent_sensor_is_listened_to_and_goes_on_without_being_opened_again(follow):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        assert follower.until_problem("sends nothing to UDP port").phase is Phase.SILENT
        fake.send(packets(fake.document, range(1)))
        state = follower.until_running()
        assert state.problem == "" and state.n_opened == 1


def test_a_reader_that_is_slow_is_not_taken_for_a_silent_sensor(follow, caplog):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        fake.send(packets(fake.document, range(4)))
        for _ in range(3):
            follower.more_frames(1)
            time.sleep(0.3)  # silence is 0.25 s
        follower.more_frames(1)
    assert not caplog.records


def test_a_sensor_with_a_new_ip_address_is_opened_again(follow, monkeypatch):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        monkeypatch.setattr(kept, "resolve", lambda _address: ("10.5.5.9", "10.5.5.1"))
        follower.until_problem("has another IP address now")
        follower.until_opened(2)


def test_a_port_that_is_taken_is_named_and_tried_again(follow):
    port = free_port()
    with fake_sensor(config_params__udp_port_lidar=port) as fake:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("0.0.0.0", port))
            follower = follow(fake.address)
            follower.until_problem(f"cannot listen at UDP port {port}")
        follower.until_opened(1)


def test_the_wish_is_set_on_the_sensor(follow):
    with fake_sensor() as fake:
        port = free_port()
        follower = follow(fake.address, udp_port_lidar=port, timestamp_mode="TIME_FROM_PTP_1588")
        state = follower.until_opened(1)
        assert fake.set == [{"timestamp_mode": "TIME_FROM_PTP_1588", "udp_port_lidar": port}]
        assert state.sensor.timestamp_mode == "TIME_FROM_PTP_1588"
        fake.send(packets(metadata(), range(1)))
        follower.until_running()


def test_a_flood_of_bad_packets_is_one_line_in_the_log(follow, caplog, capfd):
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        fake.send(packets(fake.document, range(1)))
        follower.until_running()
        caplog.clear()
        before = dict(fake.document["sensor_info"])
        fake.document["sensor_info"]["prod_sn"] = "999"
        flood = packets(fake.document, range(1, 5))
        fake.document["sensor_info"] = before
        fake.send(flood)
        follower.until_problem("what comes is of another sensor")
        follower.until_opened(2)
    assert len(caplog.records) == 1
    assert capfd.readouterr().err == ""


@contextmanager
def stranger(payload, port):
    """Another sender, at 127.0.0.2, whose packets come all the time."""
    stop = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.2", 0))

        def send():
            while not stop.wait(0.002):
                sender.sendto(payload, ("127.0.0.1", port))

        sending = threading.Thread(target=send)
        sending.start()
        try:
            yield
        finally:
            stop.set()
            sending.join()


@pytest.mark.parametrize("is_replay", [True, False], ids=["replay", "garbage"])
def test_packets_from_another_address_are_named_once_and_harm_no_frame(follow, caplog, is_replay):
    with fake_sensor() as fake:
        port = fake.document["config_params"]["udp_port_lidar"]
        follower = follow(fake.address)
        follower.until_opened(1)
        payload = packets(fake.document, range(7, 8))[0] if is_replay else bytes(1000)
        with stranger(payload, port):
            while not follower.source.state.problem:
                sent = len(follower.frames)
                fake.send(packets(fake.document, range(sent, sent + 1)))
                follower.more_frames(1)
        state = follower.source.state
        assert state.problem == (
            f"packets of 127.0.0.2 ({len(payload)} bytes) come to UDP port {port}; they are left out, as the sensor is "
            "127.0.0.1: let that sender use another port"
        )
    assert state.phase is Phase.RUNNING and state.n_opened == 1
    assert [record.levelname for record in caplog.records].count("WARNING") == 1
    for index, frame in enumerate(follower.frames):
        assert (frame.range_mm == ranges_mm(index)).all()


def test_who_sends_in_place_of_a_silent_sensor_is_named_until_it_ceases(follow, monkeypatch):
    monkeypatch.setattr(strangers, "QUIET_S", 0.3)
    with fake_sensor() as fake:
        follower = follow(fake.address)
        follower.until_opened(1)
        with stranger(bytes(1000), fake.document["config_params"]["udp_port_lidar"]):
            state = follower.until_problem("packets of 127.0.0.2")
            assert "sends nothing to UDP port" in state.problem and state.phase is Phase.SILENT
        follower.until(lambda state: "127.0.0.2" not in state.problem)
