"""What a process takes of memory, and how it gives back what it has freed.

glibc keeps freed blocks below the top of its heap. Arrays of a megabyte, made and freed ten times a second between
small blocks that stay, leave it full of holes: 500 MB resident after five minutes, of which 230 were free.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")

try:
    _malloc_trim = ctypes.CDLL(None).malloc_trim
except AttributeError:  # another C library, with habits of its own
    _malloc_trim = None


def return_freed() -> None:
    """Call now and then, not for each frame: it takes milliseconds."""
    if _malloc_trim is not None:
        _malloc_trim(0)


def resident_bytes(pid: int | str) -> int:
    """Memory that a process has in RAM; "self" is this one. 0 where there is none of this id: it has just died."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE_BYTES
    except (OSError, IndexError):
        return 0
