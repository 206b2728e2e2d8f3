"""Ouster sensors, live or recorded -> Frames."""

from .metadata import sensor_from_metadata

__all__ = ["sensor_from_metadata"]
