"""What the network reads of the resampled image: views that a turn only rolls."""

import numpy as np
import pytest
import yard

from revisitd.models.features import (
    FEATURE_SHAPES,
    LAYER_HEIGHTS_M,
    N_RINGS,
    PLAN_SIGMA_M,
    RING_REACH_M,
    WAVELENGTH_M,
    features,
)
from revisitd.models.preprocess import INPUT_SHAPE, LOG_RANGE_GAIN, N_COLUMNS, Resampler, row_elevation_rad


def of_scan(**kwargs):
    return features(Resampler(*yard.beams(128, 1024), 1024)(yard.scan(128, 1024, **kwargs)))


def image_of(reach_m, height_m, azimuth_rad):
    """The image of single points at a level distance, height and azimuth: each fills the cell that it falls into."""
    image = np.zeros(INPUT_SHAPE, np.float32)
    image[2] = 1.0
    rows = np.abs(np.arctan2(height_m, reach_m)[:, None] - row_elevation_rad()).argmin(axis=1)
    columns = np.rint(-azimuth_rad * N_COLUMNS / (2 * np.pi)).astype(int) % N_COLUMNS
    image[0, rows, columns] = LOG_RANGE_GAIN * np.log(np.hypot(reach_m, height_m))
    image[1, rows, columns] = 1.0
    return image


def test_the_views_have_the_shapes_that_the_model_wants():
    views = of_scan()
    assert {name: view.shape for name, view in views.items()} == FEATURE_SHAPES
    assert all(view.dtype == np.float32 for view in views.values())


def test_a_turn_by_a_column_rolls_each_view_by_one():
    image = Resampler(*yard.beams(64, 512), 512)(yard.scan(64, 512))
    straight, turned = features(image), features(np.roll(image, 1, axis=2))
    for name in FEATURE_SHAPES:
        np.testing.assert_allclose(turned[name], np.roll(straight[name], 1, axis=-1), atol=2e-6)


def test_a_half_turn_leaves_the_spectrum_as_it_is():
    image = Resampler(*yard.beams(64, 512), 512)(yard.scan(64, 512))
    turned = features(np.roll(image, N_COLUMNS // 2, axis=2))
    np.testing.assert_allclose(turned["spectrum"], features(image)["spectrum"], atol=2e-6)


def test_the_grid_has_what_stands_there_at_its_distance():
    ring_m = np.geomspace(*RING_REACH_M, N_RINGS)
    grid = features(image_of(ring_m[[15]], np.zeros(1), np.zeros(1)))["grid"]
    assert grid.sum() == pytest.approx(1.0, abs=1e-5)
    assert grid[:, 14:17].sum() == pytest.approx(1.0, abs=1e-5)


def test_the_spectrum_is_that_of_the_plan():
    """Against a sum over points that are all in the highest layer, each at the middle of its cell of the plan."""
    rng = np.random.default_rng(0)
    reach_m = rng.integers(19, 34, 40) + 0.5
    column = rng.choice(N_COLUMNS, 40, replace=False)
    image = image_of(reach_m, np.full(40, LAYER_HEIGHTS_M[-1] + 1.0), -column * 2 * np.pi / N_COLUMNS)
    found = np.exp(features(image)["spectrum"].reshape(len(LAYER_HEIGHTS_M), len(WAVELENGTH_M), -1)[-1])
    weight = reach_m * np.exp(-0.5 * (reach_m / PLAN_SIGMA_M) ** 2)
    at = reach_m[:, None] * np.cos((column[:, None] - np.arange(N_COLUMNS // 2)) * (2 * np.pi / N_COLUMNS))
    for wavelength_m, amplitude in zip(WAVELENGTH_M, found, strict=True):
        wanted = np.abs((weight[:, None] * np.exp(-2j * np.pi / wavelength_m * at)).sum(axis=0))
        assert np.corrcoef(amplitude, wanted)[0, 1] > 0.98


def test_an_empty_image_has_views_too():
    views = features(np.zeros(INPUT_SHAPE, np.float32))
    assert all(np.isfinite(view).all() for view in views.values()) and not views["grid"].any()
