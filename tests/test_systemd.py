"""The shipped unit under a real systemd: ready, watched, restarted, stopped; no loop for what does not mend itself.

And put in place there by the program itself, and what the journal keeps of a change.
"""

import json
from pathlib import Path

import pytest
from booted import BootedSystemd, why_not

SHIPPED = Path(__file__).resolve().parents[1] / "systemd"
SETTINGS = "/etc/revisitd/revisitd.toml"
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
# Says what the detection says of a change, into the log as the program sets it up.
CHANGE_LINE = """
import logging
from types import SimpleNamespace
import numpy as np
from revisitd.daemon import instances
from revisitd.daemon.notify import log_handler
logging.basicConfig(level=logging.INFO, handlers=[log_handler()])
found = SimpleNamespace(polarity="appeared", points=np.ones((7, 3)))
instances._log(found, SimpleNamespace(session_id=3, scene_id=17, visit=2))
"""
CHANGE_UNIT = """[Unit]
DefaultDependencies=no
[Service]
Type=oneshot
ExecStart=/opt/revisitd/bin/python /opt/units/change.py
Environment=LD_LIBRARY_PATH=/opt/python/lib
"""

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    """A machine with the service, for a sensor that does not answer."""
    units = {
        "revisitd.service": (SHIPPED / "revisitd.service").read_text(),
        "revisitd.service.d/test.conf": TEST_ONLY,
        "revisitd.sysusers": (SHIPPED / "revisitd.sysusers").read_text(),
        "change.service": CHANGE_UNIT,
        "change.py": CHANGE_LINE,
    }
    with BootedSystemd(units, tmp_path_factory.mktemp("machine")) as booted:
        booted.run("systemd-sysusers", "/opt/units/revisitd.sysusers")
        booted.run("mkdir", "/etc/revisitd")
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


def test_a_change_can_be_asked_for_in_the_journal_by_its_fields(machine):
    pytest.importorskip("systemd.journal", reason="systemd-python is not installed: it needs libsystemd's headers")
    machine.run("systemctl", "start", "change")
    line = json.loads(machine.run("journalctl", "-o", "json", "POLARITY=appeared", "SCENE=17", "VISIT=2", "SESSION=3"))
    assert line["MESSAGE"] == "change appeared at x=1.0 y=1.0 z=1.0 points=7 scene=17 visit=2"
    assert (line["SYSLOG_IDENTIFIER"], line["PRIORITY"], line["LOGGER"]) == (
        "revisitd",
        "6",
        "revisitd.daemon.instances",
    )


INSTALLED = (
    "/etc/systemd/system/revisitd.service",
    "/etc/systemd/system/multi-user.target.wants/revisitd.service",
    "/etc/sysctl.d/60-revisitd.conf",
    "/etc/sysusers.d/revisitd.conf",
)


def test_install_service_starts_it_as_its_own_user_and_uninstall_service_takes_it_away(tmp_path):
    program = "/opt/revisitd/bin/revisitd"
    with BootedSystemd({"revisitd.service.d/test.conf": TEST_ONLY}, tmp_path) as machine:
        said = machine.run(program, "install-service", "--source", "127.0.0.1:9")
        assert "started" in said and "failed" not in said
        assert machine.run("systemctl", "is-enabled", "revisitd") == "enabled\n"
        pid = machine.until("revisitd", ActiveState="active")["MainPID"]
        assert machine.run("stat", "-c", "%U", f"/proc/{pid}") == "revisitd\n"
        assert machine.run("cat", "/proc/sys/net/core/rmem_max") == "4194304\n"
        machine.run("stat", *INSTALLED)

        said = machine.run(program, "uninstall-service")
        assert "kept /etc/revisitd/revisitd.toml, /var/lib/revisitd" in said
        assert machine.show("revisitd")["ActiveState"] == "inactive"
        assert machine.run("systemctl", "is-enabled", "revisitd", check=False) in ("", "not-found\n")
        assert machine.run("ls", "-d", *INSTALLED, check=False) == ""
        machine.run("stat", "/etc/revisitd/revisitd.toml", "/var/lib/revisitd/changes.db")

        machine.run("umount", "/proc/sys/net/core/rmem_max")  # as in a container: read-only
        said = machine.run(program, "install-service", "--source", "127.0.0.1:9", "--no-start")
        assert "packets may be lost until /etc/sysctl.d/60-revisitd.conf is in force" in said
