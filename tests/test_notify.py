"""What systemd hears, with systemd-python or without it."""

import logging
import os
import socket

import pytest

from revisitd.daemon import notify as module
from revisitd.daemon.notify import log_handler, notify, watchdog_interval_s


@pytest.fixture(params=["systemd-python", "standard library"])
def way(request, monkeypatch):
    """Both ways of telling systemd; the first where it is installed."""
    if request.param == "standard library":
        monkeypatch.setattr(module, "_systemd", None)
        monkeypatch.setattr(module, "_journal", None)
    elif module._systemd is None:
        pytest.skip("systemd-python is not installed: it needs a compiler and libsystemd's headers")


def test_systemd_hears_what_it_is_told(way, tmp_path, monkeypatch):
    address = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(address)
        notify("READY=1", "STATUS=all is well")
        assert systemd.recv(1024) == b"READY=1\nSTATUS=all is well"


def test_a_manager_that_does_not_listen_is_no_error(way, tmp_path, monkeypatch):
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    notify("READY=1")
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("READY=1")


@pytest.mark.parametrize(
    "usec,pid,interval_s",
    [("60000000", "", 30.0), ("60000000", str(os.getpid()), 30.0), ("60000000", "1", None), ("", "", None)],
)
def test_the_watchdog_is_fed_twice_as_often_as_it_bites(usec, pid, interval_s, monkeypatch):
    monkeypatch.setenv("WATCHDOG_USEC", usec)
    monkeypatch.setenv("WATCHDOG_PID", pid)
    assert watchdog_interval_s() == interval_s


def test_the_journal_learns_each_lines_priority_without_systemd_python(monkeypatch):
    monkeypatch.setattr(module, "_journal", None)
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    record = logging.LogRecord("revisitd.x", logging.WARNING, "", 0, "first\nsecond", (), None)
    assert log_handler().format(record) == "<4>revisitd.x: first\n<4>second"
