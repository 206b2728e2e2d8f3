"""A file that takes some space while there is enough, and gives it back on a full disk: deleting must write, too."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

RESERVE_BYTES = 1 << 20  # rows of 50 scans become garbage rows in 400 kB of WAL


class Reserve:
    """The reserve of one data directory."""

    def __init__(self, directory: Path):
        self._directory, self._path = directory, directory / "reserve"

    def hold(self) -> None:
        """Take the space, if it is not taken and there is plenty. Raises OSError."""
        if self._path.exists() or self._free_bytes() < 4 * RESERVE_BYTES:
            return
        with open(self._path, "wb") as file:
            os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)

    def release(self) -> bool:
        """Give the space back; whether it was taken."""
        held = self._path.exists()
        self._path.unlink(missing_ok=True)
        return held

    def release_if_full(self) -> None:
        """Before a database is opened: without any space that cannot be done."""
        if self._directory.exists() and self._free_bytes() < RESERVE_BYTES:
            self.release()

    def _free_bytes(self) -> int:
        return shutil.disk_usage(self._directory).free
