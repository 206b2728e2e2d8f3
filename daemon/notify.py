"""systemd: readiness, status and watchdog; and the log, as the journal wants it.

By systemd-python where it is installed (it needs a compiler and libsystemd's headers), else by the same datagrams
from the standard library. Without systemd all of it does nothing.
"""

from __future__ import annotations

import logging
import os
import socket
import sys
import time

IDENTIFIER = "revisitd"

try:
    from systemd import daemon as _systemd
    from systemd import journal as _journal
except ImportError:
    _systemd = _journal = None


def notify(*assignments: str) -> None:
    """Tell systemd: "READY=1", "STATUS=...", "WATCHDOG=1", "STOPPING=1", "RELOADING=1". Never raises: a manager that
    does not listen is no reason to stop."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    text = "\n".join(assignments)
    try:
        if _systemd is not None:
            _systemd.notify(text)
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel:
            # A leading @ stands for the zero byte of an abstract socket.
            channel.sendto(text.encode(), "\0" + address[1:] if address[0] == "@" else address)
    except OSError as error:
        logging.getLogger(__name__).debug("cannot notify systemd: %s", error)


def notify_reloading() -> None:
    """Tell systemd that settings are being reloaded; READY=1 tells that they are."""
    notify("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")


def watchdog_interval_s() -> float | None:
    """How often systemd wants to hear "WATCHDOG=1": half of its deadline. None where it does not watch us."""
    usec, pid = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not usec.isdigit() or (pid.isdigit() and int(pid) != os.getpid()):
        return None
    return int(usec) * 1e-6 / 2


def log_handler() -> logging.Handler:
    """Where log records go: into the journal with their fields, or to stderr."""
    if "JOURNAL_STREAM" not in os.environ:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
        return handler
    if _journal is not None:
        # Fields in capitals come from `extra` of the log calls: SESSION=3, SCENE=17.
        handler = _journal.JournalHandler(SYSLOG_IDENTIFIER=IDENTIFIER)
        handler.setFormatter(logging.Formatter("%(message)s"))  # else basicConfig puts level and name before it
        return handler
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_PriorityFormatter())
    return handler


class _PriorityFormatter(logging.Formatter):
    """Each line begins with its syslog priority, "<4>", which the journal takes off again (sd-daemon(3))."""

    def format(self, record: logging.LogRecord) -> str:
        priority = 3 if record.levelno >= logging.ERROR else 4 if record.levelno >= logging.WARNING else 6
        text = f"{record.name}: {super().format(record)}"
        return "\n".join(f"<{priority}>{line}" for line in text.splitlines())
