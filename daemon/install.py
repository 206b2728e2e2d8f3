"""Puts the systemd unit in place, with its user, its settings and the kernel's buffer size; and takes it away again."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

from .config import Config, dump_config

UNIT = Path("etc/systemd/system/revisitd.service")
SYSCTL = Path("etc/sysctl.d/60-revisitd.conf")
SYSUSERS = Path("etc/sysusers.d/revisitd.conf")
SETTINGS = Path("etc/revisitd/revisitd.toml")
HIDDEN = (Path("/home"), Path("/root"), Path("/run/user"), Path("/tmp"), Path("/var/tmp"))  # from a hardened service


class InstallError(Exception):
    """The service cannot be put in place or taken away; the message says what to do."""


def install(address: str, root: Path, start: bool) -> list[str]:
    """Install the service for the sensor at `address`; what was done, a line each.

    root: "/" for this machine; elsewhere (an image being made) files are written and nothing is run.
    Raises InstallError, OSError (no permission).
    """
    program = Path(sys.executable).with_name("revisitd")
    _check(program, root)
    unit = _shipped("revisitd.service").replace("/opt/revisitd/bin/revisitd", str(program))
    done = []
    for path, text in ((UNIT, unit), (SYSCTL, _shipped("60-revisitd.conf")), (SYSUSERS, _shipped("revisitd.sysusers"))):
        _write(root / path, text)
        done.append(f"wrote {root / path}")
    settings = root / SETTINGS
    if settings.exists():
        done.append(f"kept {settings}: see that sensor.address there is {address}")
    else:
        config = Config()
        config = config.model_copy(update={"sensor": config.sensor.model_copy(update={"address": address})})
        _write(settings, dump_config(config))
        done.append(f"wrote {settings}")
    if root == Path("/"):
        _run("systemd-sysusers", str(SYSUSERS.name))
        try:
            _run("sysctl", "--quiet", "--load", f"/{SYSCTL}")
        except InstallError as error:  # in a container the kernel is not ours: the service runs all the same
            done.append(f"{error}; packets may be lost until /{SYSCTL} is in force on the machine itself")
        _run("systemctl", "daemon-reload")
        if start:
            _run("systemctl", "enable", "--quiet", "--now", UNIT.name)
            done.append("started: see `systemctl status revisitd`, `journalctl -u revisitd -f`")
        else:
            done.append("start it with: systemctl enable --now revisitd")
    return done


def uninstall(root: Path) -> list[str]:
    """Stop the service and remove what `install` wrote, but neither its settings nor its data; what was done.

    Raises InstallError, OSError (no permission).
    """
    if not (root / UNIT).exists():
        raise InstallError(f"{root / UNIT} is not there: the service is not installed")
    if root == Path("/"):
        _run("systemctl", "disable", "--quiet", "--now", UNIT.name)
    done = []
    for path in (UNIT, SYSCTL, SYSUSERS):
        (root / path).unlink(missing_ok=True)
        done.append(f"removed {root / path}")
    if root == Path("/"):
        _run("systemctl", "daemon-reload")
    done.append(f"kept {root / SETTINGS}, {root / 'var/lib/revisitd'} and the user revisitd")
    return done


def _check(program: Path, root: Path) -> None:
    if not program.exists():
        raise InstallError(f"{program} is not there: install revisitd into this environment first")
    if root != Path("/"):
        return
    if any(program.is_relative_to(hidden) for hidden in HIDDEN):
        raise InstallError(
            f"{program} cannot be seen by a hardened service: install revisitd elsewhere, for example by "
            "`python3 -m venv /opt/revisitd && /opt/revisitd/bin/pip install .`, and run "
            "`/opt/revisitd/bin/revisitd install-service` from there"
        )
    if not Path("/run/systemd/system").is_dir():
        raise InstallError("systemd does not run here; with --root DIR the files are written for another machine")


def _shipped(name: str) -> str:
    return (files("revisitd") / "systemd" / name).read_text(encoding="utf-8")


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _run(*command: str) -> None:
    found = shutil.which(command[0])
    if found is None:
        raise InstallError(f"{command[0]} is not there: this machine has no complete systemd")
    result = subprocess.run([found, *command[1:]], capture_output=True, text=True, check=False)
    if result.returncode:
        said = " ".join(result.stderr.split())
        raise InstallError(f"`{' '.join(command)}` failed with exit code {result.returncode}: {said}")
