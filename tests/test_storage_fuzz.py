"""Damaged files of the storage are answered by its own errors, or put right: a few of benchmarks/fuzz_storage.py."""

import logging

import pytest
from storage_mutants import MUTANTS, outcome_of

N = {"scan": 300, "settings": 60}  # a data directory takes longer than one file


@pytest.mark.parametrize("what", MUTANTS)
def test_a_damaged_file_is_an_error_with_a_name_or_read_right(what, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    try:
        for seed in range(N.get(what, 12)):
            assert outcome_of(what, seed), seed
    finally:
        logging.disable(logging.NOTSET)
