"""A sensor on the network: asked, set to send here, read; and what is said when it does not answer."""

import json
import socket
import threading
import time
from contextlib import suppress
from itertools import islice

import numpy as np
import pytest
from captures import COLUMNS, INIT_ID, packets, ranges_mm
from fake_sensor import METADATA, fake_sensor

from revisitd.drivers import live, sensor_http
from revisitd.drivers.errors import BadMetadata, SensorUnavailable
from revisitd.drivers.losses import Loss
from revisitd.drivers.ouster import open_source


def test_frames_are_those_that_were_sent():
    with fake_sensor() as fake, open_source(fake.address, timeout_s=5) as source:
        fake.send(packets(fake.document, range(3)))
        frames = list(islice(source, 3))
        assert source.sensor.init_id == INIT_ID and source.n_frames_estimate is None
    assert fake.requests == [("GET", METADATA)]  # it was running and sending here: nothing was set
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.range_mm, ranges_mm(index))
        assert frame.valid_ratio == 1 and frame.host_ns > 0


def test_a_sensor_that_idles_and_sends_elsewhere_is_set_up_without_persisting():
    with fake_sensor(config_params__operating_mode="STANDBY", config_params__udp_dest="10.5.5.77") as fake:
        fake.document["sensor_info"]["status"] = "STANDBY"
        open_source(fake.address).close()
        assert fake.set == [{"operating_mode": "NORMAL", "udp_dest": "127.0.0.1"}]
        assert ("POST", "/api/v1/sensor/config?reinit=true&persist=false") in fake.requests


def test_a_sensor_that_sends_to_everyone_is_left_alone():
    with fake_sensor(config_params__udp_dest="239.201.201.201") as fake:
        open_source(fake.address).close()
        assert not fake.set


def test_a_sensor_that_does_not_take_the_settings_is_an_error():
    with fake_sensor(config_params__udp_dest="10.5.5.77") as fake:
        fake.accepts = False
        with pytest.raises(SensorUnavailable, match="does not take"):
            open_source(fake.address)


def test_a_sensor_that_refuses_the_settings_is_quoted():
    with fake_sensor(config_params__udp_dest="10.5.5.77") as fake:
        fake.answers_post = 403
        with pytest.raises(SensorUnavailable, match="refuses {'udp_dest': '127.0.0.1'}: 403 {}"):
            open_source(fake.address)


def test_a_sensor_that_takes_the_settings_without_a_word_is_believed():
    with fake_sensor(config_params__udp_dest="10.5.5.77") as fake:
        fake.answers_post = 202
        open_source(fake.address).close()


def test_a_sensor_in_error_is_an_error():
    with fake_sensor() as fake:
        fake.document["sensor_info"]["status"] = "ERROR"
        with pytest.raises(SensorUnavailable, match="status is 'ERROR'"):
            open_source(fake.address)


def test_waiting_for_a_sensor_that_warms_up_ends_when_stopped():
    stop = threading.Event()
    stop.set()
    with fake_sensor() as fake:
        fake.document["sensor_info"]["status"] = "WARMUP"
        with pytest.raises(SensorUnavailable, match="status is 'WARMUP'"):
            open_source(fake.address, stop=stop)


def test_with_metadata_given_nothing_is_asked_and_nothing_set(tmp_path):
    with fake_sensor(config_params__udp_dest="10.5.5.77") as fake:
        meta = tmp_path / "sensor.json"
        meta.write_text(json.dumps(fake.document))
        with open_source("127.0.0.1", meta, timeout_s=5) as source:
            fake.send(packets(fake.document, range(1)))
            assert next(iter(source)).valid_ratio == 1
        assert not fake.requests


def test_silence_is_told_after_the_time_given():
    with fake_sensor() as fake, open_source(fake.address, timeout_s=0.1) as source:
        with pytest.raises(SensorUnavailable, match=r"sent nothing to UDP port \d+ for 0.1 s"):
            next(iter(source))


def test_a_silent_sensor_can_be_stopped():
    stop = threading.Event()
    with fake_sensor() as fake, open_source(fake.address, stop=stop) as source:
        threading.Timer(0.05, stop.set).start()
        assert list(source) == []


def test_a_restarted_sensor_ends_the_iteration():
    with fake_sensor() as fake, open_source(fake.address, timeout_s=5) as source:
        sent = packets(fake.document, range(1))
        fake.document["sensor_info"]["initialization_id"] += 1
        fake.send(sent + packets(fake.document, range(1, 4)))
        frames = []
        with pytest.raises(SensorUnavailable, match="restarted"):
            frames.extend(source)
        assert source.losses[Loss.OTHER_INIT_ID] == 64


def test_a_reader_that_is_too_slow_gets_whole_frames_and_the_rest_is_counted(monkeypatch):
    monkeypatch.setattr(live, "BACKLOG_S", 0.25)
    with fake_sensor() as fake, open_source(fake.address, timeout_s=5) as source:
        for index in range(8):
            fake.send(packets(fake.document, range(index, index + 1)))
            while source.backlog_s < 0.1 * (index + 1) - 1e-6:
                time.sleep(0.001)
        frames = list(islice(source, 3))
    assert [(frame.frame_id, frame.valid_ratio) for frame in frames] == [(4, 1), (6, 1), (7, 1)]
    assert source.losses[Loss.SKIPPED_FRAME] == 5


def test_lost_packets_are_seen_in_the_frame():
    with fake_sensor() as fake, open_source(fake.address, timeout_s=5) as source:
        sent = packets(fake.document, range(2))
        del sent[5]
        fake.send(sent)
        frames = iter(source)
        assert next(frames).valid_ratio == 1 - 16 / COLUMNS
        assert next(frames).valid_ratio == 1


def test_a_port_that_is_taken_is_named():
    with fake_sensor() as fake, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", fake.document["config_params"]["udp_port_lidar"]))
        with pytest.raises(SensorUnavailable, match=r"cannot listen at UDP port \d+ .* another program"):
            open_source(fake.address)


def test_the_port_of_imu_packets_is_left_to_other_programs():
    with fake_sensor() as fake, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        fake.document["config_params"]["udp_port_imu"] = other.getsockname()[1]
        open_source(fake.address).close()


def test_a_machine_without_a_sensor_is_an_error():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{listener.getsockname()[1]}"
    with pytest.raises(SensorUnavailable, match="no sensor answers at http://127.0.0.1.*refused"):
        open_source(address)


def test_an_answer_that_comes_in_drops_without_end_is_given_up(monkeypatch):
    monkeypatch.setattr(sensor_http, "ANSWER_TIMEOUT_S", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def drip() -> None:
            connection, _ = server.accept()
            with connection, suppress(OSError):
                connection.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
                while True:
                    connection.sendall(b" ")
                    time.sleep(0.01)

        dripping = threading.Thread(target=drip)
        dripping.start()
        with pytest.raises(SensorUnavailable, match="its answer does not end"):
            open_source(f"127.0.0.1:{server.getsockname()[1]}")
        dripping.join()


def test_a_web_server_that_is_no_sensor_is_an_error():
    with fake_sensor() as fake:
        fake.document = {"hello": "world"}
        with pytest.raises(SensorUnavailable, match="is not a sensor's metadata"):
            open_source(fake.address)
        fake.document = None
        with pytest.raises(SensorUnavailable, match="answers 404"):
            open_source(fake.address)


def test_a_name_that_is_neither_file_nor_sensor_is_an_error():
    with pytest.raises(SensorUnavailable, match="there is no sensor nowhere.invalid .*check its name"):
        open_source("nowhere.invalid")


@pytest.mark.parametrize("address", ["127.0.0.1:99999", "a b", "[::1", "os1:x", "x" * 300, "os\0", ".", "-"])
def test_an_address_that_cannot_be_one_is_an_error(address):
    with pytest.raises(SensorUnavailable) as caught:
        live.LiveSource(address)
    assert "\n" not in str(caught.value)


def test_a_sensor_with_its_lidar_off_is_an_error():
    with fake_sensor("OFF") as fake, pytest.raises(BadMetadata, match="switched off"):
        open_source(fake.address)
