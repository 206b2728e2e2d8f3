"""The committed descriptor model and what is refused in its place."""

import base64
import hashlib
import json
import shutil

import captures
import numpy as np
import pytest
import yard
from click.testing import CliRunner

from revisitd.daemon.cli import cli
from revisitd.models.descriptor import DEFAULT_MODEL, DescriptorModel, ModelError

# An ONNX file that maps (1, 1, 64, 900) to itself.
OTHER_MODEL = base64.b64decode(
    "CAg6UQoQCgF4EgF5IghJZGVudGl0eRIBZ1ocCgF4EhcKFQgBEhEKAggBCgIIAQoCCEAKAwiEB2IcCgF5EhcKFQgBEhEKAggBCgIIAQoCCEAKAwiEB0IECgAQEQ=="
)


@pytest.fixture(scope="module")
def model():
    return DescriptorModel.load()


def describe(model, count=64, columns=512, **kwargs):
    return model.describe(yard.scan(count, columns, **kwargs), *yard.beams(count, columns))


@pytest.fixture
def copied(tmp_path):
    for name in (DEFAULT_MODEL, DEFAULT_MODEL.with_suffix(".json")):
        shutil.copy(name, tmp_path)
    return tmp_path / DEFAULT_MODEL.name


def change_card(path, **changes):
    card = json.loads(path.with_suffix(".json").read_text()) | changes
    path.with_suffix(".json").write_text(json.dumps(card))


def test_a_descriptor_is_a_unit_vector_of_256(model):
    descriptor = describe(model)
    assert descriptor.shape == (256,) and descriptor.dtype == np.float32
    assert np.linalg.norm(descriptor) == pytest.approx(1.0, abs=1e-5)


def test_the_same_scan_gives_the_same_descriptor_each_time(model):
    assert np.array_equal(describe(model), describe(DescriptorModel.load()))


@pytest.mark.parametrize("cells", [1, 64, 200])
def test_turning_the_sensor_by_whole_output_columns_changes_nothing(model, cells):
    scan, geometry = yard.scan(128, 1024), yard.beams(128, 1024)
    turned = np.roll(scan, cells * 4, axis=1)
    assert np.abs(model.describe(scan, *geometry) - model.describe(turned, *geometry)).max() < 1e-5


@pytest.mark.parametrize("sensor_columns", [1, 2, 3])
def test_turning_the_sensor_by_part_of_an_output_column_changes_little(model, sensor_columns):
    scan, geometry = yard.scan(128, 1024), yard.beams(128, 1024)
    turned = np.roll(scan, sensor_columns, axis=1)
    assert np.linalg.norm(model.describe(scan, *geometry) - model.describe(turned, *geometry)) < 0.05


def test_turning_the_sensor_by_any_angle_changes_little(model):
    assert np.linalg.norm(describe(model, yaw=0.0) - describe(model, yaw=2.3456)) < 0.1


def test_distance_grows_with_the_way_between_two_scans(model):
    here = describe(model, x=-6.0)
    ways_m = (0.3, 1.0, 3.0, 8.0)
    distances = [np.linalg.norm(here - describe(model, x=-6.0 + way)) for way in ways_m]
    assert distances == sorted(distances)


def test_scans_of_two_sensors_in_one_program_do_not_mix(model):
    before = describe(model, 64, 512)
    describe(model, 128, 1024)
    assert np.array_equal(before, describe(model, 64, 512))


def test_an_empty_scan_still_gives_a_unit_vector(model):
    descriptor = model.describe(np.zeros((64, 512), np.uint32), *yard.beams(64, 512))
    assert np.linalg.norm(descriptor) == pytest.approx(1.0, abs=1e-5)


def test_the_card_is_of_the_committed_model(model):
    digest = hashlib.sha256(DEFAULT_MODEL.read_bytes()).hexdigest()
    assert model.card["sha256"] == digest and model.model_id == digest[:12]


def test_predicted_overlap_falls_with_distance_from_one(model):
    overlap = model.overlap_from_distance(np.linspace(0, 2, 100))
    assert overlap[0] == 1.0 and (np.diff(overlap) <= 0).all() and overlap[-1] >= 0


def test_an_overlap_and_its_distance_belong_together(model):
    for overlap in (0.2, 0.4, 0.6):
        assert model.overlap_from_distance(model.distance_from_overlap(overlap)) == pytest.approx(overlap, abs=1e-6)


def test_a_model_of_another_shape_is_refused(copied):
    copied.write_bytes(OTHER_MODEL)
    change_card(copied, sha256=hashlib.sha256(OTHER_MODEL).hexdigest())
    with pytest.raises(ModelError, match=r"maps .*\[1, 1, 64, 900\].*want .*\[1, 8, 24, 256\].* to \[\[1, 256\]\]"):
        DescriptorModel.load(copied)


def test_a_run_with_a_model_of_another_shape_ends_at_its_start(copied, tmp_path, monkeypatch):
    """With the exit code for the model and one line, before a frame is read."""
    copied.write_bytes(OTHER_MODEL)
    change_card(copied, sha256=hashlib.sha256(OTHER_MODEL).hexdigest())
    monkeypatch.setattr("revisitd.models.descriptor.DEFAULT_MODEL", copied)
    document = captures.metadata()
    capture = captures.write_capture(tmp_path, document, captures.packets(document, range(3)))
    result = CliRunner().invoke(cli, ["replay", str(capture), "--data", str(tmp_path / "data")])
    assert result.exit_code == 78
    (line,) = result.output.splitlines()
    assert line.startswith(f"Error: model {copied} maps")


def test_a_card_of_another_model_is_refused(copied):
    change_card(copied, sha256="0" * 64)
    with pytest.raises(ModelError, match="restore the pair"):
        DescriptorModel.load(copied)


def test_a_curve_that_is_not_monotone_is_refused(copied):
    change_card(copied, calibration={"distance": [0, 1, 2], "overlap": [1, 0.2, 0.3]})
    with pytest.raises(ModelError, match="not monotone"):
        DescriptorModel.load(copied)


@pytest.mark.parametrize(
    "calibration", [{}, {"distance": [0, 1], "overlap": [1]}, {"distance": "a", "overlap": "b"}, 3]
)
def test_a_curve_without_two_lists_of_numbers_is_refused(copied, calibration):
    change_card(copied, calibration=calibration)
    with pytest.raises(ModelError, match="calibration"):
        DescriptorModel.load(copied)


def test_a_file_that_is_no_model_is_refused(copied):
    copied.write_bytes(b"not a model")
    change_card(copied, sha256=hashlib.sha256(b"not a model").hexdigest())
    with pytest.raises(ModelError, match="cannot load model"):
        DescriptorModel.load(copied)


def test_a_missing_model_or_card_is_named(copied):
    copied.with_suffix(".json").unlink()
    with pytest.raises(ModelError, match="descriptor.json"):
        DescriptorModel.load(copied)
    with pytest.raises(ModelError, match="absent.onnx"):
        DescriptorModel.load(copied.with_name("absent.onnx"))


def test_a_card_that_is_not_json_is_refused(copied):
    copied.with_suffix(".json").write_text("{")
    with pytest.raises(ModelError, match="not JSON"):
        DescriptorModel.load(copied)
