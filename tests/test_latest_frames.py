"""A program that is too slow for its sensor does without whole frames, and says how many."""

import threading
from collections import Counter

import pytest

from revisitd.drivers.latest import DEPTH, LatestFrames
from revisitd.drivers.losses import Loss


def test_frames_come_in_order_and_the_end_of_the_source_is_the_end():
    losses = Counter()
    assert [frame for frame in LatestFrames(iter([1, None, 2]), losses) if frame] == [1, 2]
    assert not losses


def test_who_is_slow_gets_the_newest_frames_and_the_others_are_counted():
    taken, sent, losses = threading.Event(), threading.Event(), Counter()

    def source():
        yield 0
        taken.wait()
        yield from range(1, 11)
        sent.set()

    frames = iter(LatestFrames(source(), losses))
    assert next(frames) == 0
    taken.set()
    sent.wait()
    assert list(frames) == list(range(11 - DEPTH, 11))
    assert losses == {Loss.SKIPPED_FRAME: 10 - DEPTH}


def test_a_silent_source_yields_nothing_but_turns():
    silent = threading.Event()

    def source():
        silent.wait()
        yield None

    frames = iter(LatestFrames(source(), Counter()))
    assert next(frames) is None
    silent.set()
    assert [frame for frame in frames if frame is not None] == []


def test_what_the_source_raises_is_raised():
    def source():
        yield 1
        raise ValueError("broken")

    frames = iter(LatestFrames(source(), Counter()))
    with pytest.raises(ValueError, match="broken"):
        list(frames)
