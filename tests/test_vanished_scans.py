"""A scan may be deleted by the retention between the moment it is chosen and the moment it is read."""

import numpy as np
import pytest
from stored import SESSION, add_visit

from revisitd.daemon import submap_build
from revisitd.daemon.comparison import MIN_SCANS
from revisitd.daemon.config import Config
from revisitd.daemon.references import reference_cells, reference_points
from revisitd.storage.errors import ScanFileError
from revisitd.storage.store import Store


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        add_visit(store, 1, 1, store.index.start_session(**SESSION), 20)
        yield store


@pytest.fixture
def each_its_id(monkeypatch):
    """A scan's points are one point: its id, three times."""
    monkeypatch.setattr(
        "revisitd.daemon.references.map_points", lambda scan, *_, **__: np.full((1, 3), scan.scan_id, np.float32)
    )


class AnySensor:
    def get(self, digest):
        return None


def references(store):
    first_visit = store.index.scans_of_scene(1, visit=1)
    return lambda: reference_points(first_visit, store.scans, AnySensor(), 60.0, n_scans=20)[:, 0].tolist()


def test_references_do_without_a_scan_that_has_just_been_deleted(store, each_its_id):
    read = references(store)
    store.scans.delete([(1, 3), (1, 4)])
    assert read() == [i for i in range(1, 21) if i not in (3, 4)]


def test_references_of_which_none_is_left_are_an_error_with_a_name(store, each_its_id):
    read = references(store)
    store.scans.delete([(1, i) for i in range(1, 21)])
    with pytest.raises(ScanFileError, match="no scan of the scene's first visit can be read"):
        read()
    with pytest.raises(ScanFileError, match="no scan of the scene's first visit can be read"):
        reference_points(store.index.scans_of_scene(2, visit=1), store.scans, AnySensor(), 60.0)


def test_what_a_key_scan_is_fitted_to_does_without_a_scan_that_has_just_been_deleted(store, monkeypatch):
    class Swept:
        def __init__(self, scan):
            self.scan_id = scan.scan_id

        def in_map(self, *_):
            return self.scan_id

    monkeypatch.setattr("revisitd.daemon.references.sweep_of", lambda scan, *_: Swept(scan))
    first_visit = store.index.scans_of_scene(1, visit=1)
    cells = reference_cells(first_visit, store.scans, AnySensor(), Config().alignment)
    assert next(cells) == 1
    store.scans.delete([(1, i) for i in range(2, 20)])
    assert list(cells) == [20]


def test_a_submap_does_without_scans_that_cannot_be_read(store, monkeypatch):
    monkeypatch.setattr(
        submap_build, "scan_view", lambda scan, sensor, range_m: (scan, np.ones((2, 3), np.float32), None)
    )
    store.scans.delete([(1, 2)])
    damaged = store.scans.path(1, 4)
    damaged.write_bytes(damaged.read_bytes()[:-1])
    visits = np.array([1, 1, 2, 2, 3])
    submap, scans, there = submap_build.build_submap(lambda i: (store.scans.read(1, i + 1), None), visits, 25.0)
    assert there.tolist() == [True, False, True, False, True]
    assert [scan.scan_id for scan in scans] == [1, 3, 5]
    assert submap.visit.tolist() == [1, 2, 3]
    assert submap.scan.tolist() == [0, 0, 1, 1, 2, 2]


def test_too_few_scans_to_compare_are_an_error_with_numbers(store, monkeypatch):
    from revisitd.daemon.comparer import Comparer
    from revisitd.daemon.comparison import Job, Selection

    monkeypatch.setattr(submap_build, "scan_view", lambda *_: (store.scans.read(1, 1), np.ones((2, 3), np.float32), 0))
    monkeypatch.setattr(Comparer, "read", lambda self, side, i: (store.scans.read(1, int(side.scan_id[i])), None))
    ids = np.arange(1, 13)
    side = Selection(ids * 0 + 1, ids, ids, ids, np.zeros((12, 3)), np.ones(12, bool))
    store.scans.delete([(1, int(i)) for i in ids[MIN_SCANS - 1 :]])
    with pytest.raises(ScanFileError, match=f"{MIN_SCANS - 1} of 12 scans can be read"):
        Comparer(store.dir.path).compare(Job(side, side, [], [], 25.0, None))
