"""A robot that was switched off and on again: its new session is joined to the map it made before."""

import gc
import json
import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from revisitd.daemon.config import Config
from revisitd.daemon.progress import summary_text
from revisitd.daemon.relocalization import Place, Question, Relocator
from revisitd.daemon.replay import replay
from revisitd.storage.store import Store

STANDS_M = 0.05  # a frame's motion below which the robot stands
FILE_HEADER = 24  # bytes of a pcap


def poses(capture):
    """(N,) sensor seconds and (N, 4, 4) true poses of a capture's frames."""
    rows = np.loadtxt(capture.truth / "poses.txt")
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(rows[:, 4:8]).as_matrix(), rows[:, 1:4]
    return rows[:, 0], T


def part(capture, folder, first, stop):
    """Frames first .. stop - 1 as a capture of their own."""
    folder.mkdir()
    shutil.copy(capture.metadata, folder / "part.json")
    content, n_frames = capture.pcap.read_bytes(), len(poses(capture)[0])
    size = (len(content) - FILE_HEADER) // n_frames  # each frame has the same packets
    start, end = (FILE_HEADER + k * size for k in (first, stop))
    (folder / "part.pcap").write_bytes(content[:FILE_HEADER] + content[start:end])
    return folder / "part.pcap"


def run(pcap, data):
    return replay(str(pcap), data, None, Config(), rate=None, progress=lambda *_: None)


@pytest.fixture(scope="module")
def days(tiny_patrol, tmp_path_factory):
    """(first day's pcap, second day's, true T_map_sensor by the sensor's second).

    The first day is the way back of the patrol, the second the way there: the robot starts at the other end, turned
    round, and its sensor's clock shows an earlier time than the day before.
    """
    seconds, T = poses(tiny_patrol)
    drives = np.flatnonzero(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) > STANDS_M)
    turn = np.flatnonzero(np.diff(drives) > 5)  # frames that it stands or turns on the spot
    there, back = drives[turn[0]] + 3, drives[turn[-1] + 1] - 3
    folder = tmp_path_factory.mktemp("days")
    first, second = (
        part(tiny_patrol, folder / "first", back, len(T)),
        part(tiny_patrol, folder / "second", 0, there),
    )
    return first, second, dict(zip(seconds.tolist(), np.linalg.inv(T[back]) @ T, strict=True))


@pytest.fixture(scope="module")
def yesterday(days, tmp_path_factory):
    """The data directory after the first day."""
    data = tmp_path_factory.mktemp("yesterday") / "data"
    run(days[0], data)
    return data


@pytest.fixture(scope="module")
def today(days, yesterday, tmp_path_factory):
    """(data directory, summary) of the second day."""
    data = tmp_path_factory.mktemp("today") / "data"
    shutil.copytree(yesterday, data)
    return data, run(days[1], data)


def test_the_second_days_session_goes_on_in_the_first_days_map(today):
    data, summary = today
    with Store.open_reader(data) as store:
        sessions = [(row.session_id, row.map_id, row.continues) for row in store.index.sessions()]
        assert sessions == [(1, 1, None), (2, 2, None), (3, 1, 2)]
        (scene,) = store.index.scenes(map_id=1)
        assert scene.n_visits == 2
        assert store.index.maps_to_join() == [1]  # tomorrow's session is not joined to what was given up
    assert "joined to earlier maps: map 1" in summary_text(summary)


def test_its_key_scans_are_where_the_sensor_was_in_that_map(today, days):
    with Store.open_reader(today[0]) as store:
        path = store.index.trajectory(session=3)
    assert len(path.scan_id) >= 5 and path.aligned.all()
    for stamp_ns, T_map_sensor in zip(path.stamp_ns, path.T_map_sensor, strict=True):
        truth = min(days[2].items(), key=lambda pose: abs(pose[0] - stamp_ns * 1e-9))[1]
        assert np.linalg.norm(T_map_sensor[:3, 3] - truth[:3, 3]) < 0.1
        assert np.degrees(Rotation.from_matrix(T_map_sensor[:3, :3].T @ truth[:3, :3]).magnitude()) < 0.7


def test_what_changed_overnight_is_found_against_the_first_days_scans(today, days, tiny_patrol):
    staged = json.loads((tiny_patrol.truth / "changes.json").read_text())
    T_new_old = next(iter(days[2].values()))  # the patrol's own map is that of its first frame
    undone = {"appeared": "disappeared", "disappeared": "appeared"}  # seen from the way back to the way there
    with Store.open_reader(today[0]) as store:
        found = store.changes.changes()
        first, second = (store.index.trajectory(session=session).stamp_ns for session in (1, 3))
    assert len(found) == len(staged) == 2
    for change in staged:
        (match,) = [other for other in found if other.polarity == undone[change["polarity"]]]
        place = (T_new_old @ [*change["centroid"], 1.0])[:3]
        assert np.linalg.norm(match.centroid - place) < 0.5
        assert (match.session, match.visit, match.last_before_session) == (3, 2, 1)
        assert match.first_seen_ns in second and match.last_before_ns in first


def test_a_map_that_another_model_described_is_joined_too(yesterday, days, tmp_path):
    """Its scans look like nothing that today's model knows; where they are is tried all the same."""
    data = tmp_path / "data"
    shutil.copytree(yesterday, data)
    with closing(sqlite3.connect(data / "index.db")) as db, db:
        db.execute("UPDATE descriptors SET model_id = 'feedc0ffee00', descriptor = zeroblob(1024)")
    run(days[1], data)
    with Store.open_reader(data) as store:
        assert [(row.map_id, row.continues) for row in store.index.sessions()][-1] == (1, 2)
        assert store.index.db.value("SELECT status FROM instances") == "done"


def test_a_session_in_another_world_makes_a_map_of_its_own(yesterday, tmp_path):
    from revisitd.drivers.virtual import simulate

    elsewhere = simulate(tmp_path / "patrol", scenario="tiny", seed=1, beams=64, columns=512, max_s=6.5)
    data = tmp_path / "data"
    shutil.copytree(yesterday, data)
    summary = run(elsewhere.pcap, data)
    with Store.open_reader(data) as store:
        assert [row.map_id for row in store.index.sessions()] == [1, 2]
        assert store.index.maps_to_join() == [1, 2]
    assert "not joined to an earlier map (2 attempts)" in summary_text(summary)


def test_a_relocator_that_is_closed_forgets_its_places_at_once(yesterday):
    """Not when Python's collector comes by: it counts objects, not their megabytes."""
    alignment = Config().alignment
    relocator = Relocator(yesterday, alignment)
    gc.disable()
    try:
        relocator.locate(Question(1, 1, [1], alignment))
        assert n_alive(Place) == 1
        relocator.close()
        assert n_alive(Place) == 0
    finally:
        gc.enable()


def n_alive(kind):
    """How many objects of a type there are, garbage included."""
    return sum(type(thing) is kind for thing in gc.get_objects())
