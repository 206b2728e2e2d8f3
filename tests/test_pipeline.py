"""What goes wrong on a drive: noticed, counted, a session closed where it must be, and never a false change."""

import gc
import weakref
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from revisitd.daemon.config import Config
from revisitd.daemon.program import Program
from revisitd.drivers.ouster import open_source
from revisitd.storage.errors import StorageFull

virtual = pytest.importorskip("revisitd.drivers.virtual", reason="the virtual sensor needs the extra [sim]")

PERIOD_NS = 100_000_000


def frames_of(folder, seed):
    made = virtual.simulate(folder, scenario="tiny", seed=seed, beams=32, columns=512, max_s=5.0)
    with open_source(str(made.pcap)) as source:
        return [frame for frame in source if frame.valid_ratio == 1]


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Frames of five seconds of a small patrol."""
    return frames_of(tmp_path_factory.mktemp("drive"), seed=1)


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory):
    """The same in another world."""
    return frames_of(tmp_path_factory.mktemp("elsewhere"), seed=5)


def after(frame, last, periods=1):
    """A frame as if it came some periods after another."""
    moved_ns = last.stamp_ns + periods * PERIOD_NS - frame.stamp_ns
    return replace(
        frame,
        frame_id=last.frame_id + periods,
        column_ns=np.where(frame.column_valid, frame.column_ns + moved_ns, 0),
        host_ns=last.host_ns + periods * PERIOD_NS,
    )


@contextmanager
def running(tmp_path):
    with Program(tmp_path / "data", Config(), "test", wait=True) as program:
        yield program
        program.pipeline.finish()
        program.worker.drain()
        assert program.store.changes.changes() == []


def sessions(program):
    return len(program.store.index.sessions())


def test_a_sensor_that_is_blinded_for_a_second_and_a_half_begins_a_new_session(tmp_path, drive):
    with running(tmp_path) as program:
        for number, frame in enumerate(drive):
            blind = 20 <= number < 35
            program.pipeline.process(replace(frame, range_mm=np.zeros_like(frame.range_mm)) if blind else frame)
        assert program.pipeline.counts.rejected == 15
        assert program.pipeline.counts.odometry_lost == 1 and sessions(program) == 2


def test_a_robot_that_is_carried_away_begins_a_new_session(tmp_path, drive, elsewhere):
    with running(tmp_path) as program:
        last = None
        for frame in [*drive[:20], *elsewhere[:20]]:
            last = after(frame, last) if last else frame
            program.pipeline.process(last)
        assert program.pipeline.counts.odometry_lost == 1 and sessions(program) == 2


@pytest.mark.parametrize("missing,lost", [(3, 0), (5, 1)])
def test_missing_frames_are_counted_and_half_a_second_of_them_begins_a_new_session(tmp_path, drive, missing, lost):
    with running(tmp_path) as program:
        for frame in [*drive[:20], *drive[20 + missing :]]:
            program.pipeline.process(frame)
        assert program.pipeline.gate.frames_missing == missing
        assert program.pipeline.counts.odometry_lost == lost and sessions(program) == 1 + lost


def test_a_robot_that_stands_still_keeps_a_scan_now_and_then(tmp_path, drive):
    with running(tmp_path) as program:
        last = drive[0]
        program.pipeline.process(last)
        for _ in range(300):
            last = after(drive[0], last)
            program.pipeline.process(last)
        assert program.pipeline.counts.key_scans == 4  # at the start, and every ten seconds
        assert program.pipeline.counts.odometry_lost == 0 and sessions(program) == 1


def test_key_scans_that_a_full_disk_does_not_take_are_counted_and_the_session_goes_on(tmp_path, drive, monkeypatch):
    with running(tmp_path) as program:
        write, full = program.store.scans.write, iter([False, True, True, False])

        def writes(scan):
            if next(full, False):
                raise StorageFull("scans: no space left")
            return write(scan)

        monkeypatch.setattr(program.store.scans, "write", writes)
        for frame in drive:
            program.pipeline.process(frame)
        counts = program.pipeline.counts
        assert counts.not_stored == 2 and counts.key_scans == program.store.index.count_scans() > 2
        assert program.pipeline.disk_problem == "" and sessions(program) == 1


def test_a_session_that_a_full_disk_does_not_take_begins_later(tmp_path, drive, monkeypatch):
    with running(tmp_path) as program:
        start = program.store.index.start_session

        def refuse(**_):
            raise StorageFull("index.db: no space left")

        monkeypatch.setattr(program.store.index, "start_session", refuse)
        program.pipeline.process(drive[0])
        assert program.pipeline.now() is None and program.pipeline.disk_problem == "index.db: no space left"
        monkeypatch.setattr(program.store.index, "start_session", start)
        for frame in drive[1:10]:
            program.pipeline.process(frame)
        assert program.pipeline.now().session_id == 1 and program.pipeline.disk_problem == ""


def test_a_scene_that_the_disk_did_not_take_is_recorded_with_the_next_key_scan(tmp_path, drive, monkeypatch):
    with running(tmp_path) as program:
        for frame in drive[:20]:
            program.pipeline.process(frame)
        session = program.pipeline._session
        add_scene = program.store.index.add_scene

        def refuse(*_):
            raise StorageFull("index.db: no space left")

        monkeypatch.setattr(program.store.index, "add_scene", refuse)
        with pytest.raises(StorageFull):
            session.record(session.scenes.finish())
        assert program.store.index.scenes() == []
        monkeypatch.setattr(program.store.index, "add_scene", add_scene)
    with Program(tmp_path / "data", Config(), "test", wait=True) as again:
        assert len(again.store.index.scenes()) == 1


def test_a_session_that_has_ended_leaves_memory_at_once(tmp_path, drive):
    """Not when Python's collector comes by: it counts objects, not their megabytes."""
    with running(tmp_path) as program:
        gc.disable()
        try:
            program.pipeline.process(drive[0])
            session = weakref.ref(program.pipeline._session)
            program.pipeline.process(drive[1])
            program.pipeline.finish()
            assert session() is None
        finally:
            gc.enable()
