"""A step of the sensor's clock, a restart and another sensor are noticed; lost, late and damaged frames are none."""

import json
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
from captures import COLUMNS, HOST_NS, PERIOD_NS, START_NS, metadata, ranges_mm

from revisitd.daemon import pipeline
from revisitd.daemon.config import Config
from revisitd.drivers.frame import Frame
from revisitd.drivers.gate import FrameGate, Rejection
from revisitd.drivers.ouster import sensor_from_metadata

SENSOR = sensor_from_metadata(json.dumps(metadata()))
RANGE_MM = ranges_mm(0)
NS = 1_000_000_000


def frame(index: int, frame_id: int | None = None, step_ns: int = 0, host_step_ns: int = 0, sensor=SENSOR) -> Frame:
    """The frame measured `index` periods after the first one."""
    start_ns = START_NS + index * PERIOD_NS
    return Frame(
        sensor=sensor,
        frame_id=index if frame_id is None else frame_id,
        range_mm=RANGE_MM,
        reflectivity=np.zeros(SENSOR.shape, np.uint8),
        column_ns=start_ns + step_ns + np.arange(COLUMNS) * (PERIOD_NS // COLUMNS),
        column_valid=np.ones(COLUMNS, bool),
        host_ns=HOST_NS + index * PERIOD_NS + host_step_ns,
    )


def verdicts(frames: list[Frame]) -> tuple[list[Rejection | None], list[str]]:
    """What the gate says of each frame, and the interruptions."""
    gate, rejections, interruptions = FrameGate(), [], []
    for one in frames:
        rejections.append(gate.check(one))
        if gate.interruption:
            interruptions.append(f"{one.frame_id}: {gate.interruption}")
    return rejections, interruptions


def test_a_clock_that_steps_ahead_begins_a_new_time_once_three_frames_agree():
    stepped = [frame(index, step_ns=37 * NS) for index in range(3, 7)]
    rejections, interruptions = verdicts([frame(index) for index in range(3)] + stepped)
    doubtful = Rejection.TIME_DOUBTFUL
    assert rejections == [None, None, None, doubtful, doubtful, None, None]
    assert interruptions == ["5: the sensor's clock stepped by +37.000 s"]


def test_a_clock_that_locks_to_ptp_steps_by_years():
    rejections, interruptions = verdicts([frame(0), *(frame(index, step_ns=HOST_NS) for index in range(1, 5))])
    assert rejections.count(None) == 3
    assert len(interruptions) == 1 and "+1700000000" in interruptions[0]


def test_a_clock_that_steps_back_begins_a_new_time():
    rejections, interruptions = verdicts(
        [frame(index) for index in range(9)] + [frame(index, step_ns=-NS // 2) for index in range(9, 13)]
    )
    assert rejections[9:] == [Rejection.TIME_NOT_INCREASING, Rejection.TIME_NOT_INCREASING, None, None]
    assert interruptions == ["11: the sensor's clock stepped by -0.500 s"]


def test_a_short_looped_recording_begins_a_new_time_each_time():
    again = [frame(index, host_step_ns=NS) for index in range(6)]
    _, interruptions = verdicts([frame(index) for index in range(6)] + again)
    assert len(interruptions) == 1


def test_one_frame_with_a_damaged_time_is_left_out():
    rejections, interruptions = verdicts([frame(0), frame(1, step_ns=5 * NS), frame(2), frame(3)])
    assert rejections == [None, Rejection.TIME_DOUBTFUL, None, None]
    assert not interruptions


def test_lost_frames_are_no_step():
    assert verdicts([frame(0), frame(1), frame(60), frame(900)]) == ([None] * 4, [])


def test_hours_of_silence_are_no_step():
    hours = 3 * 36_000
    assert verdicts([frame(0), frame(hours, frame_id=hours % 65536)]) == ([None] * 2, [])


def test_frame_ids_that_come_round_are_no_step():
    assert verdicts([frame(0, frame_id=65535), frame(1, frame_id=0)]) == ([None] * 2, [])


def test_a_step_of_the_hosts_clock_is_none_of_the_sensors():
    assert verdicts([frame(0), frame(1, host_step_ns=-(10**18)), frame(2)]) == ([None] * 3, [])


def test_a_frame_whose_first_columns_are_lost_is_no_step():
    cut = frame(1)
    cut.column_valid[:51] = False
    cut.column_ns[:51] = 0
    assert verdicts([frame(0), cut, frame(2)]) == ([None] * 3, [])


def test_a_restarted_sensor_begins_a_new_time_at_once():
    restarted = replace(SENSOR, init_id=SENSOR.init_id + 1)
    rejections, interruptions = verdicts([frame(0), frame(1), frame(0, sensor=restarted), frame(1, sensor=restarted)])
    assert rejections == [None] * 4
    assert interruptions == ["0: the sensor was restarted, reconfigured, or is another one"]


def test_a_step_of_the_clock_ends_the_session_and_begins_another(monkeypatch):
    sessions = []

    def start(*_arguments) -> MagicMock:
        session = MagicMock(session_id=len(sessions) + 1)
        session.odometry.register.return_value.health.lost = False
        session.key_scans.wants.return_value = False
        session.record.return_value = []
        sessions.append(session)
        return session

    monkeypatch.setattr(pipeline, "Session", start)
    store = MagicMock()
    store.index.maps_to_join.return_value = []
    model = MagicMock(**{"distance_from_overlap.return_value": 1.0})
    line = pipeline.Pipeline(Config(), store, None, model, None, None, "os1", wait=False)
    for one in [frame(0), frame(1), *(frame(index, step_ns=37 * NS) for index in range(2, 6))]:
        line.process(one)
    first, second = ([call.args[0].frame_id for call in s.odometry.register.call_args_list] for s in sessions)
    assert (first, second) == ([0, 1], [4, 5])
    store.index.end_session.assert_called_once_with(1)
