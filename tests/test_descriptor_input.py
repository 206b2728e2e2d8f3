"""The network's input: one for every sensor."""

import numpy as np
import pytest
import yard

from revisitd.models.preprocess import INPUT_SHAPE, N_COLUMNS, Resampler, row_elevation_rad


def resampled(count, columns, **kwargs):
    return Resampler(*yard.beams(count, columns), columns)(yard.scan(count, columns, **kwargs))


@pytest.mark.parametrize("columns", [512, 1024, 2048])
def test_turning_by_whole_output_columns_rolls_the_input_exactly(columns):
    resample = Resampler(*yard.beams(128, columns), columns)
    scan = yard.scan(128, columns)
    turned = np.roll(scan, 37 * columns // N_COLUMNS, axis=1)
    assert np.array_equal(resample(turned), np.roll(resample(scan), 37, axis=2))


@pytest.mark.parametrize("count, columns", [(32, 512), (64, 512), (64, 1024), (128, 512), (128, 2048)])
def test_every_sensor_gives_nearly_the_same_input_for_the_same_place(count, columns):
    wanted, found = resampled(128, 1024), resampled(count, columns)
    both = (wanted[1] > 0.99) & (found[1] > 0.99)
    assert both.sum() > 0.95 * (wanted[1] > 0.99).sum()
    assert np.quantile(np.abs(wanted[0] - found[0])[both], 0.98) < 0.01  # of ln(range) / 5: 5 %


def test_ranges_of_a_wall_are_kept():
    level = np.abs(row_elevation_rad()).argmin()
    ranges = np.exp(resampled(128, 1024, x=0.0, y=0.0)[0, level] * 5)
    assert ranges.min() == pytest.approx(yard.HALF_Y_M, rel=0.01)


def test_rows_out_of_the_sensors_view_are_masked():
    shift, altitude = yard.beams(64, 512)
    narrow = np.abs(altitude) < np.deg2rad(16.6)
    scan = Resampler(shift[narrow], altitude[narrow], 512)(yard.scan(64, 512)[narrow])
    out_of_view = np.abs(row_elevation_rad()) > np.deg2rad(18.0)
    assert not scan[:, out_of_view].any()
    assert scan[2, ~out_of_view].mean() > 0.9


def test_lost_columns_are_not_looked_at_and_empty_ones_are():
    scan = yard.scan(64, 512)
    scan[:, 100:132] = 0  # two packets: no beam of these columns has a return
    inputs = Resampler(*yard.beams(64, 512), 512)(scan)
    clean = resampled(64, 512)
    in_view = clean[2] > 0
    assert (inputs[2][in_view] == 0).mean() == pytest.approx(32 / 512, abs=0.02)
    sky = (clean[1] == 0) & in_view
    assert sky.any() and (inputs[2][sky] == 1).mean() > 0.9


def test_an_empty_scan_is_a_valid_input():
    inputs = Resampler(*yard.beams(32, 512), 512)(np.zeros((32, 512), np.uint32))
    assert inputs.shape == INPUT_SHAPE and inputs.dtype == np.float32 and not inputs.any()


def test_column_counts_that_no_os1_has_are_refused():
    with pytest.raises(ValueError, match="multiple of 256"):
        Resampler(*yard.beams(32, 512), 500)


def test_an_image_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="the sensor has"):
        Resampler(*yard.beams(32, 512), 512)(np.zeros((64, 512), np.uint32))
