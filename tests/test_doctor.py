"""The doctor looks at the machine, the data and the sensor, and says how to mend what is wrong."""

import pytest
from click.testing import CliRunner
from fake_sensor import fake_sensor

from revisitd.daemon.cli import cli
from revisitd.storage.store import Store


def examine(*arguments):
    result = CliRunner().invoke(cli, ["doctor", *map(str, arguments)])
    lines = [line for line in result.output.splitlines() if not line.lstrip().startswith("->")]
    return result, {line[6:21].strip(): (line[:5].strip(), line[22:]) for line in lines}


def test_a_good_sensor_and_a_new_directory_are_well(tmp_path):
    with fake_sensor() as fake:
        result, found = examine(fake.address, "--data", tmp_path / "data")
    assert result.exit_code == 0, result.output
    assert found["sensor"][0] == found["destination"][0] == found["model"][0] == found["disk"][0] == "ok"
    assert "512x10" in found["packets"][1]
    assert found["reception"][0] == "warn" and "no packet" in found["reception"][1]
    assert not (tmp_path / "data").exists()


def test_an_absent_sensor_fails_and_the_rest_is_still_looked_at(tmp_path):
    result, found = examine("127.0.0.1:9", "--data", tmp_path)
    assert result.exit_code == 1
    assert found["sensor"][0] == "fail" and "no sensor answers" in found["sensor"][1]
    assert found["data"][0] == "ok"


def test_a_sensor_that_sends_elsewhere_is_named(tmp_path):
    with fake_sensor(config_params__udp_dest="10.1.2.3") as fake:
        _, found = examine(fake.address, "--data", tmp_path)
    assert found["destination"][0] == "warn" and "10.1.2.3" in found["destination"][1]


def test_a_store_of_scans_is_counted_and_a_foreign_directory_fails(tmp_path):
    Store.open_writer(tmp_path / "data").close()
    assert "0 scans" in examine("--data", tmp_path / "data")[1]["data"][1]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "letter.txt").write_text("dear")
    result, found = examine("--data", tmp_path / "foreign")
    assert result.exit_code == 1 and found["data"][0] == "fail"


@pytest.mark.parametrize("gb,verdict", [(1e-6, "ok"), (1e9, "fail")])
def test_the_disk_must_have_what_is_to_stay_free(tmp_path, gb, verdict):
    settings = tmp_path / "revisitd.toml"
    settings.write_text(f"[storage]\nmin_free_gb = {gb}\n")
    assert examine("--data", tmp_path / "data", "--config", settings)[1]["disk"][0] == verdict
