"""A real systemd, booted in namespaces of its own, to run the shipped unit in."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

SYSTEMD = Path("/lib/systemd/systemd")
OWN_UNITS = Path("/lib/systemd/system")
NAMESPACES = ("--mount", "--pid", "--uts", "--ipc", "--cgroup")
TARGET = """[Unit]
DefaultDependencies=no
Wants=systemd-journald.socket systemd-journald.service
"""


def why_not() -> str:
    """Why no systemd can be booted here; empty where one can."""
    if os.geteuid() != 0:
        return "only root may make the namespaces that a systemd needs"
    if not SYSTEMD.exists() or not shutil.which("nsenter"):
        return "systemd or nsenter is not installed"
    tried = subprocess.run(["unshare", *NAMESPACES, "--fork", "true"], capture_output=True, text=True, check=False)
    if tried.returncode:
        return f"namespaces are not allowed here: {tried.stderr.strip()}"
    try:
        _new_cgroup().rmdir()
    except OSError as error:
        return f"no control group can be made here: {error}"
    return ""


class BootedSystemd:
    """A context manager. units: file name -> text of what the system manager is to know beside its journal.

    The Python environment of the tests is at /opt/revisitd in there, with the program at /opt/revisitd/bin/revisitd.
    """

    def __init__(self, units: dict[str, str], tmp_path: Path):
        folder = tmp_path / "units"
        for name, text in {"test.target": TARGET, **units}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)
        for name in ("systemd-journald.service", "systemd-journald.socket"):
            (folder / name).write_text((OWN_UNITS / name).read_text())
        sites = [path for path in sys.path if path.endswith("-packages")]
        self._environment = {
            "PATH": os.environ["PATH"],
            "UNITS": str(folder),
            "PYTHON_HOME": sys.base_prefix,
            "SITES": "\n".join(sites),
        }
        self._log = tmp_path / "boot.log"

    def __enter__(self) -> BootedSystemd:
        self._cgroup = _new_cgroup()
        script = Path(__file__).with_name("systemd_namespace.sh")
        with self._log.open("wb") as log:
            self._outer = subprocess.Popen(
                ["unshare", *NAMESPACES, "--fork", "--mount-proc", "--kill-child", "bash", str(script)],
                env=self._environment,
                stdout=log,
                stderr=log,
                preexec_fn=lambda: (self._cgroup / "cgroup.procs").write_text(str(os.getpid())),
            )
        try:
            self._init = self._wait_for_init()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._outer.kill()  # takes its init along, and that all that runs under it
        self._outer.wait()
        for _ in range(100):
            try:
                for folder in sorted(self._cgroup.rglob("*/"), key=lambda path: -len(path.parts)):
                    if folder.is_dir():
                        folder.rmdir()
                self._cgroup.rmdir()
                return
            except OSError:  # its last processes are still going
                time.sleep(0.05)

    def run(self, *command: str, check: bool = True) -> str:
        """What a command says that is run in there."""
        inside = ["nsenter", "-t", str(self._init), "-m", "-p", "-u", "-i", "-C", *command]
        result = subprocess.run(inside, capture_output=True, text=True, check=False, timeout=60)
        if check and result.returncode:
            raise AssertionError(f"{command} failed: {result.stdout}{result.stderr}")
        return result.stdout

    def show(self, unit: str) -> dict[str, str]:
        """A unit's properties."""
        wanted = "ActiveState,SubState,Result,NRestarts,StatusText,MainPID,ExecMainStatus"
        lines = self.run("systemctl", "show", unit, "-p", wanted).splitlines()
        return dict(line.split("=", 1) for line in lines)

    def until(self, unit: str, timeout_s: float = 60.0, **wanted: str) -> dict[str, str]:
        """Waits until a unit's properties are as wanted, and returns all of them."""
        deadline = time.monotonic() + timeout_s
        while True:
            shown = self.show(unit)
            if all(shown[name] == value for name, value in wanted.items()):
                return shown
            if time.monotonic() > deadline:
                journal = self.run("journalctl", "--no-pager", "-n", "40", check=False)
                raise AssertionError(f"{unit} is {shown}, wanted {wanted}\n{journal}")
            time.sleep(0.1)

    def until_says(self, unit: str, words: str, timeout_s: float = 30.0) -> None:
        """Waits until a unit's status line or its journal holds these words."""
        deadline = time.monotonic() + timeout_s
        while True:
            said = self.show(unit)["StatusText"] + self.run("journalctl", "--no-pager", "-o", "cat", "-u", unit)
            if words in said:
                return
            if time.monotonic() > deadline:
                raise AssertionError(f"{unit} did not say {words!r}, but: {said}")
            time.sleep(0.1)

    def _wait_for_init(self) -> int:
        for _ in range(200):
            children = Path(f"/proc/{self._outer.pid}/task/{self._outer.pid}/children").read_text().split()
            for child in children:
                if Path(f"/proc/{child}/comm").read_text().strip() == "systemd":
                    inside = ["nsenter", "-t", child, "-m", "-p", "-C", "systemctl", "is-active", "test.target"]
                    if subprocess.run(inside, capture_output=True, check=False).stdout.strip() == b"active":
                        return int(child)
            time.sleep(0.05)
        raise AssertionError(f"systemd did not boot: {self._log.read_text()}")


def _new_cgroup() -> Path:
    unified = Path("/sys/fs/cgroup")
    if not (unified / "cgroup.controllers").exists():
        unified /= "unified"  # a machine with both hierarchies
    cgroup = unified / f"revisitd-test-{os.getpid()}-{time.monotonic_ns()}"
    cgroup.mkdir()
    return cgroup
