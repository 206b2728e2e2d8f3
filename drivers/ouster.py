"""Ouster sensors, live or recorded -> Frames: the way in for the rest of the program."""

import threading
from pathlib import Path

from .beside import read_metadata
from .errors import SourceNotFound
from .live import LiveSource
from .metadata import sensor_from_metadata
from .osf import OsfSource
from .replay import PcapSource
from .sensor_setup import AS_IT_IS, SensorWish
from .source import Source

__all__ = ["SensorWish", "Source", "open_source", "sensor_from_metadata"]
FILE_SUFFIXES = (".pcap", ".pcapng", ".osf", ".json")


def open_source(
    source: str,
    meta: Path | None = None,
    *,
    stop: threading.Event | None = None,
    timeout_s: float | None = None,
    wish: SensorWish = AS_IT_IS,
) -> Source:
    """source: a pcap or OSF file, or a sensor's host name or address.

    meta: the sensor's metadata, where it is not beside the capture; a live sensor is not configured then.
    stop: ends the iteration over a live sensor. timeout_s: silence of it that raises SensorUnavailable.
    wish: how it shall be set.
    Raises SourceNotFound, BadMetadata, BadCapture or SensorUnavailable.
    """
    path = Path(source)
    try:
        if path.is_dir():
            raise SourceNotFound(f"{path} is a folder: give a pcap or OSF file, or a sensor's address")
        if not path.exists():
            if path.suffix.lower() in FILE_SUFFIXES or "/" in source:
                raise SourceNotFound(f"there is no file {source}")
            return LiveSource(source, meta, stop, timeout_s, wish)
        if path.suffix.lower() == ".osf":
            return OsfSource(path, read_metadata(meta).text if meta else None)
        return PcapSource(path, meta)
    except OSError as error:
        raise SourceNotFound(f"{source} cannot be read: {error.strerror}") from None
