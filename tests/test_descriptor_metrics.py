"""The figures by which descriptors are judged, and the curve from distance to overlap."""

import numpy as np
import pytest

from revisitd.models.metrics import (
    balanced_weights,
    calibration_curve,
    descriptor_distances,
    pairs,
    rank_agreement,
    recall,
)

RNG = np.random.default_rng(0)


def test_each_pair_of_a_matrix_counts_once():
    assert sorted(pairs(np.array([[0, 1, 2], [1, 0, 3], [2, 3, 0]]))) == [1, 2, 3]


def test_distances_are_euclidean():
    some = RNG.normal(size=(5, 8))
    some /= np.linalg.norm(some, axis=1, keepdims=True)
    assert descriptor_distances(some)[1, 3] == pytest.approx(np.linalg.norm(some[1] - some[3]))


def test_distance_that_falls_with_overlap_agrees_wholly():
    overlap = RNG.random(100)
    assert rank_agreement(np.sqrt(2 - 2 * overlap), overlap) == pytest.approx(1.0)
    assert rank_agreement(overlap, overlap) == pytest.approx(-1.0)


def test_each_tenth_of_overlap_weighs_alike():
    overlap = np.concatenate((np.full(900, 0.05), np.full(100, 0.55)))
    weight = balanced_weights(overlap)
    assert weight[:900].sum() == pytest.approx(weight[900:].sum()) and weight.mean() == pytest.approx(1.0)


def test_the_calibration_curve_follows_the_pairs_and_only_falls():
    overlap = RNG.random(20_000) ** 3
    distance = np.sqrt(2 - 2 * overlap) + RNG.normal(0, 0.02, overlap.size)
    knots, expected = calibration_curve(distance, overlap)
    assert (np.diff(knots) > 0).all() and (np.diff(expected) <= 0).all() and expected[0] == 1.0
    assert np.abs(np.interp(distance, knots, expected) - overlap).mean() < 0.03


def test_a_query_counts_as_found_if_one_of_the_nearest_k_is_its_place():
    distance = np.array([[0.1, 0.2, 0.9], [0.3, 0.1, 0.2], [0.1, 0.2, 0.3]])
    is_place = np.array([[True, False, False], [True, False, False], [False, False, False]])
    # The third query has no entry of its place and is not asked.
    assert recall(distance, is_place, 1) == (0.5, 2)
    assert recall(distance, is_place, 3) == (1.0, 2)
