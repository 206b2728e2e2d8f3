"""Geometries of the sensors whose scans are stored."""

from __future__ import annotations

from ..drivers.frame import Sensor
from ..drivers.metadata import sensor_from_metadata
from ..storage.datadir import DataDir


class Sensors:
    """Sensors by the digest of their geometry; each is read and worked out once."""

    def __init__(self, data_dir: DataDir):
        self._data_dir = data_dir
        self._known: dict[str, Sensor] = {}

    def get(self, digest: str) -> Sensor:
        """The sensor of this digest. Raises DataDirError where its metadata is missing."""
        if digest not in self._known:
            self._known[digest] = sensor_from_metadata(self._data_dir.get_sensor(digest))
        return self._known[digest]

    def put(self, sensor: Sensor) -> None:
        """Remember a sensor, on disk too."""
        self._data_dir.put_sensor(sensor.digest, sensor.metadata)
        self._known[sensor.digest] = sensor
