"""The shipped unit under a real systemd: ready, watched, restarted, stopped; no loop for what does not mend itself."""

import json
from pathlib import Path

import pytest
from booted import BootedSystemd, why_not

SHIPPED = Path(__file__).resolve().parents[1] / "systemd" / "revisitd.service"
SETTINGS = "/srv/revisitd.toml"  # /etc is the real machine's
# Beside the shipped unit: no other units exist in there, and what takes a minute on a robot takes seconds.
TEST_ONLY = """[Unit]
DefaultDependencies=no
[Service]
WatchdogSec=4
RestartSec=1
TimeoutStopSec=10
TimeoutAbortSec=3
# A Python that was built for another place looks for its library there.
Environment=LD_LIBRARY_PATH=/opt/python/lib
"""

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    """A machine with the service, for a sensor that does not answer."""
    unit = SHIPPED.read_text().replace("/etc/revisitd/revisitd.toml", SETTINGS)
    units = {"revisitd.service": unit, "revisitd.service.d/test.conf": TEST_ONLY}
    with BootedSystemd(units, tmp_path_factory.mktemp("machine")) as booted:
        yield booted


@pytest.fixture
def service(machine):
    """The service, started anew with good settings, and stopped afterwards."""
    configure(machine, '[sensor]\naddress = "127.0.0.1:9"\n')
    machine.run("systemctl", "reset-failed", check=False)
    machine.run("systemctl", "start", "revisitd", check=False)
    machine.until("revisitd", 30.0, ActiveState="active")
    yield machine
    machine.run("systemctl", "stop", "revisitd", check=False)


def configure(machine, settings):
    machine.run("sh", "-c", f"printf '%s' '{settings}' > {SETTINGS}")


def kill(machine, name):
    machine.run("kill", f"-{name}", machine.show("revisitd")["MainPID"])


def journal(machine):
    return [json.loads(line) for line in machine.run("journalctl", "-u", "revisitd", "-o", "json").splitlines()]


def test_it_is_ready_without_a_sensor_and_says_what_it_waits_for(service):
    shown = service.show("revisitd")
    assert (shown["ActiveState"], shown["NRestarts"]) == ("active", "0")
    service.until_says("revisitd", "no sensor answers at http://127.0.0.1:9")
    assert "waiting" in service.run("/opt/revisitd/bin/revisitd", "status")


def test_its_store_is_its_own_and_readable_by_others(service):
    listed = service.run("stat", "-c", "%U %a %n", "/var/lib/revisitd", "/var/lib/revisitd/changes.db")
    assert listed.split("\n")[:2] == ["revisitd 755 /var/lib/revisitd", "revisitd 644 /var/lib/revisitd/changes.db"]


def test_a_program_that_hangs_is_restarted_by_the_watchdog(service):
    kill(service, "STOP")
    service.until("revisitd", ActiveState="active", NRestarts="1")
    assert any("Watchdog timeout" in line["MESSAGE"] for line in journal(service))


def test_a_program_that_crashes_is_restarted(service):
    kill(service, "KILL")
    service.until("revisitd", ActiveState="active", NRestarts="1")


def test_wrong_settings_end_it_for_good_and_are_named(service):
    configure(service, "[detection]\ntau = 0.3\n")
    service.run("systemctl", "restart", "revisitd", check=False)
    shown = service.until("revisitd", ActiveState="failed")
    assert (shown["ExecMainStatus"], shown["NRestarts"]) == ("78", "0")
    assert any("detection.tau: unknown setting" in line["MESSAGE"] for line in journal(service))


def test_new_settings_are_taken_at_a_reload_and_wrong_ones_change_nothing(service):
    configure(service, '[sensor]\naddress = "127.0.0.1:9"\n[detection]\ntau_m = 0.25\n')
    service.run("systemctl", "reload", "revisitd")
    service.until_says("revisitd", "settings reloaded: detection changed")
    configure(service, "[detection]\ntau = 0.3\n")
    service.run("systemctl", "reload", "revisitd")
    service.until_says("revisitd", "settings not reloaded")
    assert service.show("revisitd")["ActiveState"] == "active"


def test_a_stop_is_orderly_and_no_failure(service):
    service.run("systemctl", "stop", "revisitd")
    shown = service.show("revisitd")
    assert (shown["ActiveState"], shown["Result"]) == ("inactive", "success")
    service.until_says("revisitd", "revisitd has stopped")
