"""The gate lets whole, current frames through and counts the rest."""

import json
from dataclasses import replace

import numpy as np
import pytest
from captures import COLUMNS, PERIOD_NS, START_NS, metadata, ranges_mm

from revisitd.drivers.errors import BadCapture
from revisitd.drivers.frame import Frame
from revisitd.drivers.gate import FrameGate, Rejection
from revisitd.drivers.ouster import sensor_from_metadata

SENSOR = sensor_from_metadata(json.dumps(metadata()))


def frame(index: int, n_lost: int = 0) -> Frame:
    """The frame of this index; its first n_lost columns did not arrive."""
    valid = np.arange(COLUMNS) >= n_lost
    column_ns = START_NS + index * PERIOD_NS + np.arange(COLUMNS) * (PERIOD_NS // COLUMNS)
    return Frame(
        sensor=SENSOR,
        frame_id=index,
        range_mm=np.where(valid, ranges_mm(index), 0).astype(np.uint32),
        reflectivity=np.zeros(SENSOR.shape, np.uint8),
        column_ns=np.where(valid, column_ns, 0),
        column_valid=valid,
        host_ns=0,
    )


def test_whole_frames_pass():
    gate = FrameGate()
    assert [gate.check(frame(index)) for index in range(3)] == [None] * 3
    assert gate.accepted == 3 and not any(gate.losses.values())


def test_a_frame_with_too_few_columns_is_rejected_and_its_columns_are_counted():
    gate = FrameGate(min_valid_ratio=0.9)
    assert gate.check(frame(0, n_lost=52)) is Rejection.TOO_FEW_COLUMNS
    assert gate.check(frame(1, n_lost=51)) is None
    assert gate.columns_missing == 103
    assert gate.losses["frames rejected: too few columns"] == 1


def test_only_columns_of_the_azimuth_window_are_expected():
    windowed = replace(SENSOR, column_window=(400, 99))
    seen = (np.arange(COLUMNS) < 100) | (np.arange(COLUMNS) >= 400)
    whole = frame(0)
    cut = replace(whole, sensor=windowed, column_valid=seen, column_ns=np.where(seen, whole.column_ns, 0))
    gate = FrameGate()
    assert cut.valid_ratio == 1
    assert gate.check(cut) is None and gate.columns_missing == 0


def test_time_that_repeats_or_goes_back_is_rejected():
    gate = FrameGate()
    assert gate.check(frame(5)) is None
    assert gate.check(frame(5)) is Rejection.TIME_NOT_INCREASING
    assert gate.check(frame(3)) is Rejection.TIME_NOT_INCREASING
    assert gate.check(frame(6)) is None


def test_one_damaged_time_does_not_become_the_time_that_later_frames_are_held_against():
    gate = FrameGate()
    damaged = frame(0)
    damaged.column_ns[7] = 2**62
    assert gate.check(damaged) is Rejection.TIME_DAMAGED
    assert gate.check(frame(1)) is None


@pytest.mark.parametrize("range_mm", [0, 50])
def test_a_covered_sensor_is_rejected(range_mm):
    blind = replace(frame(0), range_mm=np.full(SENSOR.shape, range_mm, np.uint32))
    assert FrameGate().check(blind) is Rejection.NO_RETURNS


def test_frames_that_never_came_are_counted_by_their_ids():
    gate = FrameGate()
    for index in (10, 11, 15, 16):
        gate.check(frame(index))
    assert gate.frames_missing == 3


def test_a_restart_of_the_ids_is_not_a_loss_of_frames():
    gate = FrameGate()
    gate.check(frame(10))
    gate.check(replace(frame(11), frame_id=0))
    gate.check(replace(frame(12), frame_id=60000))
    assert gate.frames_missing == 0


def test_a_source_without_any_whole_frame_is_an_error_that_says_what_came():
    gate = FrameGate()
    gate.check(frame(0, n_lost=500))
    with pytest.raises(BadCapture, match=r"walk.pcap .*1 too few columns; 500 columns missing"):
        gate.require_accepted("walk.pcap")
    gate.check(frame(1))
    gate.require_accepted("walk.pcap")


def test_a_frame_without_valid_columns_has_no_time():
    with pytest.raises(ValueError):
        frame(0, n_lost=COLUMNS).stamp_ns  # noqa: B018
