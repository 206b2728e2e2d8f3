"""What the commands print of the stored results."""

import csv
import io
import json

import numpy as np
import pytest
from stored import make_change, pose

from revisitd.daemon import report
from revisitd.storage.changes import ChangeStore


@pytest.fixture
def changes(tmp_path):
    store = ChangeStore.open_writer(tmp_path / "changes.db", "00000000-0000-0000-0000-000000000001")
    store.add(make_change("appeared", at=(3.0, -2.0, 0.5), n_points=1000, first_seen_ns=991_000_000_001))
    store.add(make_change("disappeared", at=(-130.25, 0.0, 0.0), n_points=50, scene=12, first_seen_ns=2 * 10**12))
    yield store.changes()
    store.close()


def test_the_table_is_aligned_and_says_what_people_ask(changes):
    header, first, second = report.changes_table(changes).splitlines()
    assert header.split() == "id polarity state x y z points scene visit first seen (UTC)".split()
    assert "appeared" in first and "3.00" in first and "1000" in first and first.endswith("2025-10-09 08:53:20")
    assert second.split()[:3] == ["2", "disappeared", "present"]
    assert first.index("1000  ") + 4 == second.index("50  ", 40) + 2 == header.index("points") + 6


def test_without_changes_the_table_says_so():
    assert report.changes_table([]) == "no changes"


def test_json_has_exactly_the_promised_fields(changes):
    first, second = json.loads(report.changes_json(changes, with_points=False))
    assert list(first) == [
        "id", "polarity", "centroid", "n_points", "first_seen_ns", "scene", "visit", "session",
    ]  # fmt: skip
    assert (first["id"], first["polarity"], first["n_points"]) == (1, "appeared", 1000)
    assert first["first_seen_ns"] == 991_000_000_001
    assert (second["scene"], second["visit"], second["session"]) == (12, 2, 1)
    np.testing.assert_allclose(first["centroid"], changes[0].centroid, atol=1e-4)


def test_json_with_points_carries_all_of_them(changes):
    for written, change in zip(json.loads(report.changes_json(changes, with_points=True)), changes, strict=True):
        assert list(written)[-1] == "points"
        np.testing.assert_allclose(written["points"], change.points, atol=1e-4)


def test_no_changes_are_an_empty_list_in_json():
    assert json.loads(report.changes_json([], with_points=True)) == []


def test_csv_reads_back_with_a_header(changes):
    rows = list(csv.DictReader(io.StringIO(report.changes_csv(changes))))
    assert [row["polarity"] for row in rows] == ["appeared", "disappeared"]
    assert rows[0]["first_seen_ns"] == "991000000001"
    assert float(rows[1]["min_x_m"]) == pytest.approx(changes[1].box_min[0], abs=1e-4)


def test_a_trajectory_keeps_every_nanosecond():
    stamps = np.array([1_760_000_000_123_456_789, 991_000_000_001], np.int64)
    text = report.trajectory_tum(stamps, np.stack([pose(1.0, 2.0, 3.0), pose(yaw=np.pi / 2)]))
    first, second = (line.split() for line in text.splitlines())
    assert (first[0], second[0]) == ("1760000000.123456789", "991.000000001")
    assert [float(value) for value in first[1:]] == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose([float(v) for v in second[4:]], [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)


def test_a_trajectory_without_scans_is_empty():
    assert report.trajectory_tum(np.empty(0, np.int64), np.empty((0, 4, 4))) == ""
