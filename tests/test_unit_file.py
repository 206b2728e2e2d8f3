"""The shipped unit, judged by systemd's own tools, and put in place by install-service."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from revisitd.daemon.cli import cli
from revisitd.daemon.config import load_config

SHIPPED = Path(__file__).resolve().parents[1] / "systemd" / "revisitd.service"
MOST_EXPOSED = 1.5  # of systemd's scale to 10

needs_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd-analyze is not installed")


@pytest.fixture
def unit(tmp_path):
    """The unit with a program that exists, for the tools that look for it."""
    path = tmp_path / "revisitd.service"
    path.write_text(SHIPPED.read_text().replace("/opt/revisitd/bin/revisitd", "/bin/true"))
    return path


@needs_systemd
def test_the_unit_has_nothing_that_systemd_does_not_understand(unit):
    result = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True, check=False)
    # Of other units on the machine it complains too.
    assert [line for line in result.stderr.splitlines() if "revisitd" in line] == []


@needs_systemd
def test_the_unit_is_hardened(unit):
    command = ["systemd-analyze", "security", "--offline=true", "--no-pager", unit]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    assert float(re.search(r"exposure level.*: ([0-9.]+)", said)[1]) <= MOST_EXPOSED


def invoke(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_the_service_is_installed_for_a_sensor_and_its_settings_are_good(tmp_path):
    result = invoke("install-service", "--source", "os-1.local", "--root", tmp_path)
    assert result.exit_code == 0, result.output
    assert load_config(tmp_path / "etc/revisitd/revisitd.toml").sensor.address == "os-1.local"
    written = (tmp_path / "etc/systemd/system/revisitd.service").read_text()
    assert re.search(r"^ExecStart=(.*) run --config /etc/revisitd/revisitd.toml", written, re.M)
    assert "rmem_max" in (tmp_path / "etc/sysctl.d/60-revisitd.conf").read_text()


def test_settings_of_an_earlier_installation_are_kept(tmp_path):
    settings = tmp_path / "etc/revisitd/revisitd.toml"
    settings.parent.mkdir(parents=True)
    settings.write_text('[sensor]\naddress = "os-9.local"\n')
    assert "kept" in invoke("install-service", "--source", "os-1.local", "--root", tmp_path).output
    assert load_config(settings).sensor.address == "os-9.local"


def test_an_uninstalled_service_leaves_settings_and_data_alone(tmp_path):
    invoke("install-service", "--source", "os-1.local", "--root", tmp_path)
    result = invoke("uninstall-service", "--root", tmp_path)
    assert result.exit_code == 0, result.output
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file())
    assert left == ["etc/revisitd/revisitd.toml"]
    again = invoke("uninstall-service", "--root", tmp_path)
    assert (again.exit_code, "not installed" in again.output) == (69, True)
