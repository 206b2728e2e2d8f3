"""A process that is killed at any instant loses nothing that it was told is stored: a few of benchmarks/kills.py."""

from killing import kill_many


def test_after_kills_at_random_instants_all_that_was_acknowledged_is_there(tmp_path):
    wrong, _ = kill_many(tmp_path / "data", n=8, seed=3, longest_s=0.3)
    assert wrong == []
