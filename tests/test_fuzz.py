"""Damaged input is a clear DriverError or a correct result, never another exception, a crash or a hang.

Some seeds of each kind; `python tests/benchmarks/fuzz.py` tries thousands.
"""

import random
from itertools import islice

import pytest
from captures import packets
from fake_sensor import fake_sensor
from mutants import outcome_of

from revisitd.drivers.ouster import open_source

SEEDS = range(60)


@pytest.mark.parametrize(
    "what, outcomes",
    [
        ("packets", {"ok"}),
        ("pcap", {"ok", "BadCapture"}),
        ("metadata", {"ok", "BadMetadata"}),
        ("osf", {"ok", "BadCapture"}),
        ("http", {"SensorTaken", "SensorUnavailable"}),
    ],
)
def test_damaged_input_is_an_error_that_says_so_or_is_read(what, outcomes):
    assert {outcome_of(what, seed) for seed in SEEDS} == outcomes


def test_datagrams_of_any_size_and_content_are_left_out():
    rng = random.Random(0)
    with fake_sensor() as fake, open_source(fake.address, timeout_s=5) as source:
        good = packets(fake.document, range(2))
        sizes = [0, 1, 47, 48, len(good[0]) - 1, len(good[0]), len(good[0]) + 1, 9000, 65_000]
        fake.send([rng.randbytes(rng.choice(sizes)) for _ in range(50)] + good)
        frames = list(islice(source, 2))
    assert [frame.frame_id for frame in frames] == [0, 1] and all(frame.valid_ratio == 1 for frame in frames)
