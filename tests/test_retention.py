"""What is deleted when the disk or the quota is full, in which order, and what stays."""

import contextlib
import itertools
import os
import threading

import numpy as np
import pytest
from stored import SESSION, add_visit, make_change, make_scan

from revisitd.storage.retention import Retention, finish_garbage, used_bytes
from revisitd.storage.store import Store
from revisitd.storage.usefulness import Tier, least_useful

KEPT, RECENT_NS = 4, 10_000_000_000
SECOND = 1_000_000_000
PLENTY = {"quota_bytes": 10**12, "min_free_bytes": 0}


@pytest.fixture
def store(tmp_path):
    with Store.open_writer(tmp_path / "data") as store:
        yield store


def retention(store, **limits) -> Retention:
    return store.retention(**{**PLENTY, **limits}, kept_per_visit=KEPT, recent_ns=RECENT_NS)


def order(store):
    """All scans in the order in which they would be deleted: (tier, scan ids) of each tier."""
    tiers = {}
    while victims := least_useful(store.dir, 10_000, KEPT, RECENT_NS):
        tiers[victims[0].tier] = [victim.scan_id for victim in victims]
        with store.index.transaction():
            store.index.db.write_many("DELETE FROM scans WHERE scan_id = ?", [(i,) for i in tiers[victims[0].tier]])
    return tiers


def next_session(store):
    """An old session's scans are not recent ones."""
    return store.index.start_session(**SESSION)


def apparent_bytes(path):
    """Sizes of all files; a file may go while they are added up."""
    total = 0
    for root, _, names in os.walk(path):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                total += os.path.getsize(os.path.join(root, name))
    return total


def test_nothing_is_deleted_while_there_is_room(store):
    add_visit(store, 1, 1, next_session(store), 10)
    keeper = retention(store)
    keeper.step()
    report = keeper.step()
    assert (report.n_deleted, report.more, report.problem) == (0, False, "")
    assert report.used_bytes == pytest.approx(apparent_bytes(store.dir.path), rel=0.1)
    assert store.index.counts()["scans"] == 10


def test_scans_go_in_the_order_of_their_use(store):
    session = next_session(store)
    first = add_visit(store, 1, 1, session, 8)
    old = add_visit(store, 1, 2, session, 8, first_ns=100 * SECOND)
    before = add_visit(store, 1, 3, session, 8, first_ns=200 * SECOND)
    after = add_visit(store, 1, 4, session, 8, first_ns=300 * SECOND)
    latest = add_visit(store, 1, 5, session, 8, first_ns=400 * SECOND)
    outside = store.new_scan_id()
    store.add_scan(make_scan(outside, session))
    change = make_change(scene=1, visit=4, session=session, last_before_session=session, last_before_ns=203 * SECOND)
    store.changes.add(change)
    recent = store.new_scan_id()
    store.add_scan(make_scan(recent, next_session(store)))
    tiers = order(store)
    assert list(tiers) == list(Tier)
    assert set(tiers[Tier.SURPLUS]) < {*first, *old, *latest}
    assert tiers[Tier.OUTSIDE] == [outside]
    assert set(tiers[Tier.OLD_VISIT]) < set(old)
    assert set(tiers[Tier.EVIDENCE_SURPLUS]) | set(tiers[Tier.EVIDENCE]) == {*before, *after}
    assert set(tiers[Tier.REFERENCE]) < {*first, *latest}
    assert tiers[Tier.RECENT] == [recent]


def test_what_is_kept_of_a_visit_covers_its_path_evenly(store):
    ids = add_visit(store, 1, 1, next_session(store), 40)
    next_session(store)
    surplus = order(store)[Tier.SURPLUS]
    kept = [i for i in ids if i not in surplus]
    assert len(kept) == KEPT
    assert np.diff(kept).tolist() == pytest.approx([10] * (KEPT - 1), abs=1)


def test_a_robot_that_stood_still_leaves_few_scans_of_that_place(store):
    session = next_session(store)
    ids = add_visit(store, 1, 1, session, 10)
    visit = store.index.visits(1)[0].visit_id
    standing = [store.new_scan_id() for _ in range(30)]
    for scan_id in standing:
        scan = make_scan(scan_id, session, T_map_sensor=store.scans.read(session, ids[-1]).T_map_sensor)
        store.add_scan(scan, [visit])
    next_session(store)
    kept = {*ids, *standing} - set(order(store)[Tier.SURPLUS])
    assert len(kept) == KEPT
    assert len(kept & set(standing)) <= 2


def test_a_scan_of_two_scenes_is_kept_for_the_one_that_needs_it(store):
    session = next_session(store)
    add_visit(store, 1, 1, session, 4)
    shared = add_visit(store, 1, 2, session, 4)
    add_visit(store, 1, 3, session, 4)
    store.index.add_scene(2, session, np.zeros((1, 2)), 2.5, 20.0)
    visit = store.index.open_visit(2, 1, session, 0)
    store.index.add_visit_scans(visit, shared[:2])
    next_session(store)
    assert order(store)[Tier.OLD_VISIT] == shared[2:]


def test_old_visits_go_as_a_whole_oldest_first(store):
    session = next_session(store)
    visits = [add_visit(store, 1, number, session, 4, first_ns=number * 100 * SECOND) for number in range(1, 6)]
    next_session(store)
    assert order(store)[Tier.OLD_VISIT] == visits[1] + visits[2] + visits[3]


def test_a_deleted_scan_leaves_no_file_no_row_and_no_place_in_a_visit(store):
    session = next_session(store)
    add_visit(store, 1, 1, session, 8)
    next_session(store)
    keeper = retention(store, quota_bytes=used_bytes(store.dir.path, store.index.db) - 1)
    assert keeper.step().n_deleted >= 1
    left = store.index.trajectory().scan_id.tolist()
    assert [scan_id for _, scan_id in store.scans.iter_ids()] == left == store.index.scans_of_scene(1).scan_id.tolist()
    assert len(store.index.all_descriptors("feedc0ffee00")[0]) == len(left)
    assert store.index.visits(1)[0].number == 1


def test_files_that_the_index_does_not_know_stay(store):
    session = next_session(store)
    stranger = store.new_scan_id()
    store.scans.write(make_scan(stranger, session))
    add_visit(store, 1, 1, session, 3)
    keeper = retention(store, quota_bytes=1)
    while keeper.step().more:
        pass
    assert list(store.scans.iter_ids()) == [(session, stranger)]


def test_what_a_crash_left_of_a_deletion_is_finished_at_the_next_start(store):
    session = next_session(store)
    ids = add_visit(store, 1, 1, session, 3)
    with store.index.transaction():
        store.index.db.write_many("INSERT INTO garbage (session_id, scan_id) VALUES (?, ?)", [(session, ids[0])])
        store.index.db.write("DELETE FROM scans WHERE scan_id = ?", (ids[0],))
    store.close()
    with Store.open_writer(store.dir.path) as store:
        assert [scan_id for _, scan_id in store.scans.iter_ids()] == ids[1:]
        assert finish_garbage(store.index.db, store.scans) == 0


def test_folders_without_scans_go(store):
    session = next_session(store)
    ids = add_visit(store, 1, 1, session, 3)
    store.scans.delete([(session, scan_id) for scan_id in ids])
    assert not (store.scans.directory / str(session)).exists()
    store.add_scan(make_scan(store.new_scan_id(), session))


def test_the_last_scans_of_a_place_go_for_the_quota_with_a_word_about_it(store):
    add_visit(store, 1, 1, next_session(store), 4)
    next_session(store)
    assert "scans that are needed are deleted" in retention(store, quota_bytes=1).step().problem
    report = retention(store, quota_bytes=1).step()
    assert (report.n_deleted, report.more) == (0, False)
    assert "without any scans" in report.problem


def test_the_last_scans_of_a_place_stay_where_others_have_filled_the_disk(store):
    session = next_session(store)
    for number in (1, 2, 3):
        ids = add_visit(store, 1, number, session, 4)
    next_session(store)
    keeper = retention(store, min_free_bytes=10**15)
    assert keeper.step().n_deleted == 4
    report = keeper.step()
    assert (report.n_deleted, report.more) == (0, False)
    assert "no scan may go" in report.problem
    assert store.index.scans_of_scene(1, visit=3).scan_id.tolist() == ids


def test_the_quota_holds_within_two_percent_while_ten_times_as_much_is_written(store, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)  # nine tenths of the time; not what is tested
    session, quota = next_session(store), 8_000_000
    keeper, large = retention(store, quota_bytes=quota), make_scan(shape=(64, 512)).range_mm
    written, used = 0, []

    def keep(scan_id):
        while keeper.step().more:
            pass
        used.append(used_bytes(store.dir.path, store.index.db))

    for number in itertools.count(1):
        ids = add_visit(store, 1, number, session, 40, first_ns=number * 100 * SECOND, range_mm=large, after_each=keep)
        written += 40 * store.scans.path(session, ids[-1]).stat().st_size
        if written > 10 * quota:
            break
    assert 0.95 * quota < max(used) < 1.02 * quota
    assert apparent_bytes(store.dir.path) == pytest.approx(used[-1], rel=0.02)
    assert len(store.index.scans_of_scene(1, visit=1).scan_id) == KEPT


def test_deletion_beside_a_fast_writer_disturbs_neither(store, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    session, done = next_session(store), threading.Event()
    keeper = retention(store, quota_bytes=used_bytes(store.dir.path, store.index.db) + 4_000_000)

    def keep():
        while not done.is_set():
            store.grown.wait(1.0)
            store.grown.clear()
            while keeper.step().more:
                pass

    thread = threading.Thread(target=keep)
    thread.start()
    for number in range(1, 9):
        add_visit(store, 1, number, session, 40, first_ns=number * 100 * SECOND, shape=(32, 256))
    done.set()
    store.grown.set()
    thread.join()
    while keeper.step().more:
        pass
    on_disk = list(store.scans.iter_ids())
    assert 0 < len(on_disk) < 250
    assert [scan_id for _, scan_id in on_disk] == store.index.trajectory().scan_id.tolist()
    assert len(store.index.scans_of_scene(1, visit=1).scan_id) == KEPT
