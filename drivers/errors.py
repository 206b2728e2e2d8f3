"""What can go wrong on the sensor side. Messages are one line: what is wrong, what was seen, what to do."""


class DriverError(Exception):
    """Base of all errors of the drivers."""


class SourceNotFound(DriverError):
    """There is no such file, or its metadata is missing."""


class BadMetadata(DriverError):
    """The metadata is not usable, or does not describe the sensor whose packets were seen."""


class BadCapture(DriverError):
    """The recording cannot be read, or holds no frames of the sensor."""


class SensorUnavailable(DriverError):
    """The sensor does not answer, or does not send."""


class SensorRefused(SensorUnavailable):
    """The sensor answers, but does not take the settings wished for."""


class SensorChanged(SensorUnavailable):
    """The sensor is not any more as it was when it was opened: open it again."""


class SensorTaken(SensorChanged):
    """Another client has set the sensor to send elsewhere, or otherwise."""
