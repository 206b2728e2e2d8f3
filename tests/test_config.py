"""Settings files."""

import pytest

from revisitd.daemon.config import Config, ConfigError, dump_config, load_config
from revisitd.drivers.sensor_setup import SensorWish


def write(tmp_path, text):
    path = tmp_path / "revisitd.toml"
    path.write_text(text)
    return path


def test_what_dump_config_prints_is_read_back_as_it_was(tmp_path):
    config = load_config(write(tmp_path, "[detection]\ntau_m = 0.25\n[scenes]\nalpha_m2 = 240\n"))
    assert config.detection.tau_m == 0.25
    assert load_config(write(tmp_path, dump_config(config))) == config


def test_a_sensor_is_left_as_it_is_where_nothing_else_is_said(tmp_path):
    assert Config().sensor.wish == SensorWish()
    text = "[sensor]\ntimestamp_mode = 'TIME_FROM_PTP_1588'\nazimuth_window_mdeg = [0, 180000]\npersist = true\n"
    config = load_config(write(tmp_path, text))
    assert config.sensor.wish == SensorWish(
        timestamp_mode="TIME_FROM_PTP_1588", azimuth_window=(0, 180_000), persist=True
    )
    assert load_config(write(tmp_path, dump_config(config))) == config


def test_every_setting_says_what_it_is():
    for section, value in Config():
        assert type(value).__doc__, section
        for name, field in type(value).model_fields.items():
            assert field.description, f"{section}.{name}"


@pytest.mark.parametrize(
    "text,says",
    [
        ("[detection]\ntua_m = 0.3\n", "detection.tua_m: unknown setting; known here: cluster_distance_m"),
        ("[detecton]\n", "detecton: unknown setting; known here: alignment"),
        ("[scenes]\nalpha_m2 = -5\n", "scenes.alpha_m2 = -5: input should be greater than 0"),
        ("[scenes]\nalpha_m2 = 'big'\n", "scenes.alpha_m2 = 'big': input should be a valid number"),
        ("[scenes\n", "not valid TOML"),
        ("[sensor]\nlidar_mode = '1000x10'\n", "sensor.lidar_mode = '1000x10': input should be '', '512x10'"),
        ("[sensor]\nazimuth_window_mdeg = [0]\n", "sensor.azimuth_window_mdeg = [0]: value error, two angles from 0"),
    ],
)
def test_a_wrong_setting_is_named_with_its_file_and_what_is_allowed(tmp_path, text, says):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert str(error.value).startswith(f"{path}: ")
    assert says in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match="none.toml: cannot be read: No such file"):
        load_config(tmp_path / "none.toml")


def test_other_settings_have_another_digest(tmp_path):
    other = load_config(write(tmp_path, "[detection]\ntau_m = 0.25\n"))
    assert other.digest != Config().digest == Config().digest
