"""A virtual patrol from its packets to the changes, held against the truth of the virtual world."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from revisitd.daemon.cli import cli
from revisitd.daemon.config import Config
from revisitd.daemon.replay import replay
from revisitd.storage.store import Store


@pytest.fixture(scope="module")
def capture(tiny_patrol):
    return tiny_patrol


@pytest.fixture(scope="module")
def patrol(capture, tmp_path_factory):
    """(data directory, summary) of the patrol replayed."""
    data = tmp_path_factory.mktemp("data") / "store"
    return data, run(capture, data)


def run(capture, data):
    return replay(str(capture.pcap), data, None, Config(), rate=None, progress=lambda *_: None)


def listed(data, *arguments):
    result = CliRunner().invoke(cli, ["changes", "--data", str(data), "--format", "json", *arguments])
    assert result.exit_code == 0, result.output
    return json.loads(result.output)


def test_every_staged_change_is_found_once_and_nothing_else_is_reported(capture, patrol):
    staged = json.loads((capture.truth / "changes.json").read_text())
    found = listed(patrol[0])
    assert len(found) == len(staged) == 2
    for change in staged:
        (match,) = [other for other in found if other["polarity"] == change["polarity"]]
        assert np.linalg.norm(np.subtract(match["centroid"], change["centroid"])) < 0.5


def test_the_points_of_a_change_cover_what_was_to_be_seen_of_it(capture, patrol):
    found = {change["polarity"]: np.array(change["points"]) for change in listed(patrol[0], "--points")}
    for change in json.loads((capture.truth / "changes.json").read_text()):
        truth, points = np.array(change["points"]), found[change["polarity"]]
        distance = np.linalg.norm(truth[:, None] - points[None], axis=2)
        assert (distance.min(axis=1) < 0.15).mean() > 0.75  # of the object's surface
        assert (distance.min(axis=0) < 0.25).mean() > 0.95  # and hardly anything beside it


def test_a_place_is_seen_as_it_was_and_as_it_became_and_nothing_is_said_of_what_no_beam_reached(capture, patrol):
    (crate,) = [c for c in json.loads((capture.truth / "changes.json").read_text()) if c["polarity"] == "disappeared"]

    def states(x, y, z):
        arguments = [f"{value:.3f}" for value in (x, y, z)]
        result = CliRunner().invoke(cli, ["place", *arguments, "--data", str(patrol[0]), "--format", "json"])
        assert result.exit_code == 0, result.output
        return json.loads(result.output)

    history = states(*crate["centroid"])
    assert [seen["state"] for seen in history if seen["visit"] == 1][:1] == ["occupied"]
    assert history[-1]["state"] == "free"
    assert "changed" in [seen["verdict"] for seen in history]
    x, y, z = crate["centroid"]
    assert {seen["state"] for seen in states(x, y, z - 5.0)} == {"not observed"}  # under the ground


def test_key_scans_are_where_the_sensor_was(capture, patrol):
    result = CliRunner().invoke(cli, ["trajectory", "--data", str(patrol[0])])
    ours = np.loadtxt(result.output.splitlines())
    truth = np.loadtxt(capture.truth / "poses.txt")
    same_time = np.abs(ours[:, :1] - truth[:, 0]).argmin(axis=1)
    np.testing.assert_allclose(ours[:, 0], truth[same_time, 0], atol=1e-3)
    error = np.linalg.norm(ours[:, 1:4] - truth[same_time, 1:4], axis=1)
    assert np.sqrt((error**2).mean()) < 0.1


def test_nothing_is_dropped_and_each_key_scan_is_on_disk(patrol):
    data, summary = patrol
    assert summary.instances_dropped == summary.instances_failed == 0
    assert summary.instances_done == summary.counts.instances >= 1
    assert summary.losses == {}
    with Store.open_reader(data) as store:
        assert len(list(store.scans.iter_ids())) == summary.counts.key_scans == store.index.counts()["scans"]


def test_the_same_capture_gives_the_same_changes_again(capture, patrol, tmp_path):
    run(capture, tmp_path / "again")
    assert listed(tmp_path / "again", "--points") == listed(patrol[0], "--points")


def test_a_change_says_when_and_by_what_it_was_found(patrol):
    with Store.open_reader(patrol[0]) as store:
        for change in store.changes.changes():
            assert change.last_before_ns < change.first_seen_ns
            assert change.evidence["scans_looking_through"] >= 2
            assert change.evidence["scans_showing_it"] >= 3
            assert 0.5 < change.confidence <= 1.0
            assert change.config_digest == Config().digest
            assert 0 < change.alignment_residual_m < 0.15


def test_json_has_the_documented_fields(patrol):
    fields = ["id", "polarity", "centroid", "n_points", "first_seen_ns", "scene", "visit", "session"]
    assert all(list(change) == fields for change in listed(patrol[0]))
    assert all(list(change) == [*fields, "points"] for change in listed(patrol[0], "--points"))
    assert listed(patrol[0], "--min-points", "100000") == []


def test_the_map_is_drawn(patrol, tmp_path):
    picture = tmp_path / "map.png"
    result = CliRunner().invoke(cli, ["plot", "--data", str(patrol[0]), "-o", str(picture)])
    assert result.exit_code == 0, result.output
    assert picture.read_bytes().startswith(b"\x89PNG")
