"""What a scan file promises: exactness, and a clear word where it is not whole."""

import struct
import zlib

import numpy as np
import pytest
from stored import make_scan

from revisitd.storage import scanfile
from revisitd.storage.errors import ScanFileError, StorageFull
from revisitd.storage.scans import ScanStore


@pytest.fixture
def store(tmp_path):
    store = ScanStore(tmp_path / "scans")
    store.prepare()
    return store


def assert_equal(scan, other):
    for name, value in vars(scan).items():
        found = getattr(other, name)
        if isinstance(value, np.ndarray):
            assert found.dtype == value.dtype, name
            np.testing.assert_array_equal(found, value, err_msg=name)
        else:
            assert type(found) is type(value), name
            assert found == value or value != value, name


def test_a_scan_comes_back_bit_by_bit(store):
    scan = make_scan(41, shape=(128, 1024))
    store.write(scan)
    assert_equal(scan, store.read(1, 41))


@pytest.mark.parametrize("largest", [0, 255, 256, 65_535, 65_536, 2**24 - 1, 2**24, 2**32 - 1])
def test_ranges_of_every_width_are_exact(store, largest):
    range_mm = np.full((4, 8), largest, np.uint32)
    range_mm[0, 0] = 0
    store.write(make_scan(1, shape=(4, 8), range_mm=range_mm))
    np.testing.assert_array_equal(store.read(1, 1).range_mm, range_mm)


def test_arrays_in_any_memory_order_are_exact(store):
    turned = np.arange(16 * 64, dtype=np.uint32).reshape(64, 16).T
    store.write(make_scan(1, range_mm=turned))
    np.testing.assert_array_equal(store.read(1, 1).range_mm, turned)


def test_a_scan_without_alignment_has_no_residual(store):
    store.write(make_scan(1, aligned=False, alignment_residual_m=float("nan")))
    assert np.isnan(store.read(1, 1).alignment_residual_m)


def test_arrays_that_were_read_may_be_changed(store):
    store.write(make_scan(1))
    scan = store.read(1, 1)
    for array in (scan.range_mm, scan.column_ns, scan.column_valid, scan.descriptor, scan.T_map_sensor):
        assert array.flags.writeable


def test_writing_says_the_size_of_the_file(store):
    n_bytes = store.write(make_scan(1))
    assert n_bytes == store.path(1, 1).stat().st_size


def test_every_cut_of_a_file_is_named_and_refused(store):
    store.write(make_scan(7))
    path = store.path(1, 7)
    whole = path.read_bytes()
    for length in [0, 1, 7, 21, 22, 100, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:length])
        with pytest.raises(ScanFileError, match=r"7\.scan: cut short"):
            store.read(1, 7)


def test_every_flipped_bit_is_noticed(store):
    store.write(make_scan(7))
    path = store.path(1, 7)
    whole = path.read_bytes()
    for position in range(0, len(whole), max(1, len(whole) // 200)):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises(ScanFileError, match=r"7\.scan"):
            store.read(1, 7)


def test_a_file_of_a_newer_version_is_refused_with_advice(store):
    store.write(make_scan(7))
    path = store.path(1, 7)
    data = bytearray(path.read_bytes())
    struct.pack_into("<H", data, 8, scanfile.VERSION + 1)
    path.write_bytes(data)
    with pytest.raises(ScanFileError, match="newer revisitd.*upgrade"):
        store.read(1, 7)


def test_a_file_of_another_kind_is_refused(store):
    path = store.path(1, 7)
    path.parent.mkdir(parents=True)
    path.write_bytes(b"%PDF-1.7 and so on, for some more bytes")
    with pytest.raises(ScanFileError, match="not a scan file"):
        store.read(1, 7)


def test_a_header_that_makes_no_sense_is_refused_although_its_checksum_holds(store):
    head, body = b'{"shape": [4]}', b""
    checksum = zlib.crc32(body, zlib.crc32(head))
    prefix = scanfile.PREFIX.pack(scanfile.MAGIC, scanfile.VERSION, len(head), len(body), checksum)
    path = store.path(1, 7)
    path.parent.mkdir(parents=True)
    path.write_bytes(prefix + head + body)
    with pytest.raises(ScanFileError, match="not laid out"):
        store.read(1, 7)


def test_a_missing_scan_is_named(store):
    with pytest.raises(ScanFileError, match=r"7\.scan: no such scan file"):
        store.read(1, 7)


def test_a_file_moved_to_another_id_is_noticed(store):
    store.write(make_scan(7))
    store.path(1, 7).rename(store.path(1, 8))
    with pytest.raises(ScanFileError, match="holds scan 7"):
        store.read(1, 8)


def test_a_deleted_scan_is_gone_and_deleting_it_again_is_no_error(store):
    store.write(make_scan(7))
    store.delete([(1, 7)])
    store.delete([(1, 7)])
    assert list(store.iter_ids()) == []


def test_ids_are_listed_in_order_across_folders_and_sessions(store):
    for session, scan_id in [(2, 1500), (1, 999), (1, 1000), (1, 7), (10, 20_000)]:
        store.write(make_scan(scan_id, session))
    (store.directory / "1" / "0" / "notes.txt").write_text("not ours")
    assert list(store.iter_ids()) == [(1, 7), (1, 999), (1, 1000), (2, 1500), (10, 20_000)]
    assert store.highest_id() == 20_000


def test_what_a_crash_left_half_written_is_cleared_and_never_listed(store):
    leftover = store.directory / "tmp" / "7.scan.4711"
    leftover.write_bytes(b"half")
    assert list(store.iter_ids()) == []
    store.prepare()
    assert not leftover.exists()


def test_a_failed_write_leaves_nothing_behind(store, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(StorageFull, match=r"7\.scan: no space left"):
        store.write(make_scan(7))
    monkeypatch.undo()
    assert list(store.iter_ids()) == []
    assert list((store.directory / "tmp").iterdir()) == []
