"""One file for each key scan: exact ranges, column times, poses, and all that the index row needs.

Layout: `scans/<session>/<scan_id // 1000>/<scan_id>.scan`. The bytes of a file are described in scanfile.py.
"""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import scanfile
from .errors import ScanFileError
from .faults import naming
from .files import make_dir, sync_dir, write_atomically

logger = logging.getLogger(__name__)

SUFFIX = ".scan"
IDS_PER_DIR = 1000


@dataclass(frozen=True, eq=False)
class Scan:
    """A key scan: one rotation with its poses. H beams, W columns, staggered as the sensor sent them."""

    scan_id: int
    session: int
    stamp_ns: int  # sensor clock, at the last valid column: where the poses are
    host_ns: int  # host clock, ns since 1970
    frame_id: int
    sensor_digest: str  # names the sensor's metadata in the store
    range_mm: np.ndarray  # (H, W) uint32; 0 = no return
    reflectivity: np.ndarray  # (H, W) uint8
    column_ns: np.ndarray  # (W,) int64, sensor clock; 0 where the column was lost
    column_valid: np.ndarray  # (W,) bool
    T_map_sensor: np.ndarray  # (4, 4) float64, at the scan's end
    T_odom_sensor: np.ndarray  # (4, 4) float64, at the scan's end
    T_start_end: np.ndarray  # (4, 4) float64, motion during the sweep: the scan's end seen from its start
    descriptor: np.ndarray  # (256,) float32, unit length
    model_id: str  # of the descriptor
    aligned: bool  # T_map_sensor was corrected by registration to stored scans
    alignment_residual_m: float  # of that registration; NaN where there was none


class ScanStore:
    """The scan files under a directory. One writer; any number of readers, also in other processes.

    Safe to call from several threads as long as one of them writes.
    """

    def __init__(self, directory: Path):
        self.directory = Path(directory)

    def prepare(self) -> None:
        """For the writer: create the directory, and clear what a crash left half-written."""
        make_dir(self._temporary_dir)
        for leftover in self._temporary_dir.iterdir():
            leftover.unlink()

    def path(self, session: int, scan_id: int) -> Path:
        """Where a scan's file lies, or would lie."""
        return self.directory / str(session) / str(scan_id // IDS_PER_DIR) / f"{scan_id}{SUFFIX}"

    def write(self, scan: Scan) -> int:
        """Write a scan, durably, and return the file's size in bytes. Raises StorageUnavailable, OSError."""
        data = scanfile.encode(scan)
        path = self.path(scan.session, scan.scan_id)
        with naming(path):
            try:
                make_dir(path.parent)
                write_atomically(path, data, self._temporary_dir)
            except FileNotFoundError:  # the folder was empty, and deleted by the housekeeping in this moment
                make_dir(path.parent)
                write_atomically(path, data, self._temporary_dir)
        return len(data)

    def read(self, session: int, scan_id: int, images: bool = True) -> Scan:
        """Read a scan, bit by bit what was written; without images, what its index row needs. Raises ScanFileError."""
        path = self.path(session, scan_id)
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise ScanFileError(f"{path}: no such scan file: deleted by the retention, or by hand") from None
        except OSError as error:
            raise ScanFileError(f"{path}: cannot be read: {error.strerror}") from error
        scan = Scan(**scanfile.decode(data, path, images))
        if (scan.session, scan.scan_id) != (session, scan_id):
            raise ScanFileError(f"{path}: holds scan {scan.scan_id} of session {scan.session}: move it back")
        return scan

    def read_all(self, ids: Iterable[tuple[int, int]]) -> list[Scan]:
        """Those scans (session, scan_id) that can be read: one may be deleted at any time, or be damaged."""
        found = []
        for session, scan_id in ids:
            try:
                found.append(self.read(session, scan_id))
            except ScanFileError as error:
                logger.warning("done without: %s", error)
        return found

    def delete(self, ids: Iterable[tuple[int, int]]) -> None:
        """Remove the files of scans (session, scan_id), durably, and the folders that they leave empty.

        None there is no error: a crash may have come between file and index. Raises StorageUnavailable, OSError.
        """
        paths = [self.path(*scan) for scan in ids]
        with naming(self.directory):
            for path in paths:
                path.unlink(missing_ok=True)
            for folder in {path.parent for path in paths}:
                if folder.is_dir():
                    sync_dir(folder)
                    _remove_empty(folder)
                    _remove_empty(folder.parent)

    def iter_ids(self) -> Iterator[tuple[int, int]]:
        """(session, scan_id) of every scan file, ascending, whatever the index says."""
        for session in _numbered(self.directory):
            for group in _numbered(self.directory / str(session)):
                for path in _scan_files(self.directory / str(session) / str(group)):
                    yield session, int(path.stem)

    def highest_id(self) -> int:
        """The highest scan id on disk, 0 without any: ids above it are free, whatever the index says.

        Ids grow with sessions and with time: only the newest folder is looked at, not months of files.
        """
        for session in reversed(_numbered(self.directory)):
            for group in reversed(_numbered(self.directory / str(session))):
                files = _scan_files(self.directory / str(session) / str(group))
                if files:
                    return int(files[-1].stem)
        return 0

    @property
    def _temporary_dir(self) -> Path:
        return self.directory / "tmp"


def _remove_empty(directory: Path) -> None:
    """Remove a directory that holds nothing; one that does stays."""
    try:
        directory.rmdir()
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.ENOENT):
            raise


def _numbered(directory: Path) -> list[int]:
    """Names of the numbered entries, ascending. No such directory: none."""
    if not directory.is_dir():
        return []
    return sorted(int(entry.name) for entry in directory.iterdir() if entry.name.isdecimal())


def _scan_files(directory: Path) -> list[Path]:
    """The scan files of one folder, by id; other names are not ours."""
    ours = (path for path in directory.glob(f"*{SUFFIX}") if path.stem.isdecimal())
    return sorted(ours, key=lambda path: int(path.stem))
