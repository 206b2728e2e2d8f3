"""Other programs read changes.db while it is written: benchmarks/readers.py for two seconds."""

from benchmarks.readers import measure


def test_readers_and_the_writer_never_see_an_error_of_each_other(tmp_path):
    errors, polls, _, scan_s, change_s = measure(tmp_path / "data", seconds=2.0, n_readers=4)
    assert errors == []
    assert polls > 4 and len(scan_s) == len(change_s) > 1
