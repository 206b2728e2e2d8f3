"""OptMap's objective and its greedy maximisation."""

import itertools

import numpy as np
import pytest

from revisitd.daemon.submaps import descriptor_distances, representation_loss, select, travel_weights


def drifting_descriptors(n, seed=0, step=0.25):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(n, 32)) * step / np.sqrt(32)
    walk = np.cumsum(steps, axis=0) + np.eye(1, 32)
    return (walk / np.linalg.norm(walk, axis=1, keepdims=True)).astype(np.float32)


def gamma(descriptors, visit, chosen):
    distances, weights = descriptor_distances(descriptors), travel_weights(descriptors, visit)
    return representation_loss(distances, weights, []) - representation_loss(distances, weights, list(chosen))


def test_the_greedy_choice_reaches_its_bound_and_in_practice_the_optimum():
    for seed in range(5):
        d = drifting_descriptors(12, seed)
        visit = np.zeros(12, int)
        best = max(gamma(d, visit, c) for c in itertools.combinations(range(12), 4))
        assert gamma(d, visit, select(d, visit, 4)) >= 0.95 * best > (1 - 1 / np.e) * best


def test_it_represents_a_scene_better_than_equal_strides():
    better = 0
    for seed in range(10):
        d = drifting_descriptors(120, seed)
        visit = np.zeros(120, int)
        better += gamma(d, visit, select(d, visit, 8)) > gamma(d, visit, np.linspace(0, 119, 8).astype(int))
    assert better >= 9


def test_the_loss_is_one_without_and_zero_with_every_scan():
    d = drifting_descriptors(20)
    distances, weights = descriptor_distances(d), travel_weights(d, np.zeros(20, int))
    assert representation_loss(distances, weights, []) == pytest.approx(1.0)
    assert representation_loss(distances, weights, list(range(20))) == pytest.approx(0.0, abs=1e-3)


def test_a_parked_robot_adds_no_weight():
    d = drifting_descriptors(10)
    d = np.vstack([d, np.repeat(d[-1:], 30, axis=0)])
    assert travel_weights(d, np.zeros(40, int))[10:].sum() == pytest.approx(0.0, abs=1e-9)


def test_several_visits_are_all_represented():
    d = np.vstack([drifting_descriptors(30, 1), drifting_descriptors(30, 2)])
    chosen = select(d, np.repeat([1, 2], 30), 6)
    assert (chosen < 30).any() and (chosen >= 30).any()


def test_fewer_scans_than_asked_for_are_all_taken_in_order():
    assert select(drifting_descriptors(5), np.zeros(5, int), 12).tolist() == [0, 1, 2, 3, 4]
