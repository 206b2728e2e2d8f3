"""OptMap's objective and its greedy maximisation."""

import itertools

import numpy as np
import pytest

from revisitd.daemon.submaps import representation_loss, select, travel_weights, unshared

ONE_MODEL = "feedc0ffee00"


def drifting_descriptors(n, seed=0, step=0.25):
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(n, 32)) * step / np.sqrt(32)
    walk = np.cumsum(steps, axis=0) + np.eye(1, 32)
    return (walk / np.linalg.norm(walk, axis=1, keepdims=True)).astype(np.float32)


def apart(descriptors, model_id=ONE_MODEL):
    """As a calibration would have it by which overlap falls evenly to nothing at a distance of 1."""
    model_id = np.broadcast_to(np.array(model_id), len(descriptors))
    return unshared(descriptors, model_id, lambda distance: np.maximum(1.0 - distance, 0.0))


def gamma(distances, visit, chosen):
    weights = travel_weights(distances, visit)
    return representation_loss(distances, weights, []) - representation_loss(distances, weights, list(chosen))


def test_the_greedy_choice_reaches_its_bound_and_in_practice_the_optimum():
    for seed in range(5):
        d = apart(drifting_descriptors(12, seed))
        visit = np.zeros(12, int)
        best = max(gamma(d, visit, c) for c in itertools.combinations(range(12), 4))
        assert gamma(d, visit, select(d, visit, 4)) >= 0.95 * best > (1 - 1 / np.e) * best


def test_it_represents_a_scene_better_than_equal_strides():
    better = 0
    for seed in range(10):
        d = apart(drifting_descriptors(120, seed))
        visit = np.zeros(120, int)
        better += gamma(d, visit, select(d, visit, 8)) > gamma(d, visit, np.linspace(0, 119, 8).astype(int))
    assert better >= 9


def test_the_loss_is_one_without_and_zero_with_every_scan():
    distances = apart(drifting_descriptors(20))
    weights = travel_weights(distances, np.zeros(20, int))
    assert representation_loss(distances, weights, []) == pytest.approx(1.0)
    assert representation_loss(distances, weights, list(range(20))) == pytest.approx(0.0, abs=1e-3)


def test_a_parked_robot_adds_no_weight():
    d = drifting_descriptors(10)
    d = np.vstack([d, np.repeat(d[-1:], 30, axis=0)])
    assert travel_weights(apart(d), np.zeros(40, int))[10:].sum() == pytest.approx(0.0, abs=1e-9)


def test_several_visits_are_all_represented():
    d = np.vstack([drifting_descriptors(30, 1), drifting_descriptors(30, 2)])
    chosen = select(apart(d), np.repeat([1, 2], 30), 6)
    assert (chosen < 30).any() and (chosen >= 30).any()


def test_fewer_scans_than_asked_for_are_all_taken_in_order():
    assert select(apart(drifting_descriptors(5)), np.zeros(5, int), 12).tolist() == [0, 1, 2, 3, 4]


def test_the_distance_of_two_scans_is_what_they_are_expected_not_to_share():
    d = np.array([[1.0, 0.0], [0.96, 0.28], [-1.0, 0.0]])
    assert apart(d)[0] == pytest.approx([0.0, np.sqrt(0.08), 1.0])


def test_descriptors_of_two_models_are_never_compared():
    """A scene that was first visited before the model was replaced: each model's scans are represented by its own."""
    d = np.repeat(np.eye(2, 32)[:1], 10, axis=0)  # they would all seem to be one scan
    models = np.repeat(["feedc0ffee00", "0123456789ab"], 5)
    distances = apart(d, models)
    assert (distances[:5, 5:] == 1.0).all() and (distances[:5, :5] == 0.0).all()
    chosen = select(distances, np.repeat([1, 2], 5), 2)
    assert (chosen < 5).any() and (chosen >= 5).any()
