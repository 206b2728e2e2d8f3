"""What a sensor knows of itself: its configuration, as it is, as it will be, and as it is kept; its restarts."""

import copy
import json
import threading
import time

from ouster.sdk import core

from ..metadata import parse_metadata

FIRST_BOOT_NS = 20_000_000_000  # a sensor's clock counts from its power-up, and it measures some seconds later
DEFAULTS = {  # of parameters that an older capture's metadata does not name
    "azimuth_window": [0, 360_000],
    "timestamp_mode": "TIME_FROM_INTERNAL_OSC",
    "udp_port_imu": 7503,
    "udp_port_lidar": 7502,
    "udp_profile_imu": "LEGACY",
}
CHOICES = {
    "operating_mode": ("NORMAL", "STANDBY"),
    "timestamp_mode": ("TIME_FROM_INTERNAL_OSC", "TIME_FROM_SYNC_PULSE_IN", "TIME_FROM_PTP_1588"),
    "udp_profile_imu": ("LEGACY",),
    "udp_profile_lidar": (
        "LEGACY",
        "RNG15_RFL8_NIR8",
        "RNG15_RFL8_NIR8_DUAL",
        "RNG19_RFL8_SIG16_NIR16",
        "RNG19_RFL8_SIG16_NIR16_DUAL",
    ),
}
COLUMNS = (512, 1024, 2048)
PTP = "TIME_FROM_PTP_1588"


class Refused(Exception):
    """A configuration that this sensor does not take."""


class Device:
    """The state of one sensor, shared by its HTTP server and its sender.

    metadata: the capture's. serial: another one than the capture's. warmup_s: from a new configuration until it
    measures again.
    """

    def __init__(self, metadata: str, serial: int | None, warmup_s: float):
        self._document = json.loads(parse_metadata(metadata).to_json_string())  # in today's layout, whatever it was
        for part in ("ouster-sdk", "user_data"):
            self._document.pop(part)
        data, self._info = self._document["lidar_data_format"], self._document["sensor_info"]
        self._fps = data["fps"]
        self._info["prod_sn"] = str(serial) if serial else self._info["prod_sn"] or "0"
        self.recorded = {  # the only configuration that the capture's packets fit as they are
            **DEFAULTS,
            **self._document["config_params"],
            "lidar_mode": f"{data['columns_per_frame']}x{data['fps']}",
            "operating_mode": "NORMAL",
            "udp_dest": "",  # that of the recording would be a stranger's machine
            "udp_profile_lidar": data["udp_profile_lidar"],
        }
        self._recorded_format = copy.deepcopy(data)
        self._persisted = copy.deepcopy(self.recorded)
        self._lock = threading.RLock()
        self._warmup_s = warmup_s
        self._ready_s = 0.0
        self.generation = 0  # grows with each restart
        self.n_boots = 0
        self.config = copy.deepcopy(self._persisted)
        self.staged = copy.deepcopy(self._persisted)

    @property
    def status(self) -> str:
        """As the sensor tells it: RUNNING, WARMUP or STANDBY."""
        if self.config["operating_mode"] != "NORMAL":
            return "STANDBY"
        return "RUNNING" if time.monotonic() >= self._ready_s else "WARMUP"

    @property
    def ids(self) -> tuple[int, int]:
        """Serial, init id."""
        return int(self._info["prod_sn"]), self._info["initialization_id"]

    def metadata(self) -> dict:
        """The document that GET sensor/metadata answers with."""
        with self._lock:
            document = copy.deepcopy(self._document)
            document["config_params"] = copy.deepcopy(self.config)
            document["lidar_data_format"] = self._format()
            document["sensor_info"]["status"] = self.status
            return document

    def info(self) -> core.SensorInfo:
        """The metadata for the SDK, which takes a lidar that sends to nobody for switched off."""
        document = self.metadata()
        document["config_params"]["udp_dest"] = document["config_params"]["udp_dest"] or "127.0.0.1"
        return core.SensorInfo(json.dumps(document))

    def configure(self, params: dict, reinit: bool, persist: bool) -> None:
        """Stages parameters; with reinit they hold from now on, and the lidar restarts. Raises Refused."""
        for name, value in params.items():
            self._require_known(name, value)
        with self._lock:
            self.staged |= params
            if persist:
                self._persisted |= params
            if reinit:
                self.config = copy.deepcopy(self.staged)
                self._restart(self._warmup_s)

    def reboot(self, boot_s: float) -> None:
        """Off and on again: what was not persisted is lost, and the clock begins anew."""
        with self._lock:
            self.config = copy.deepcopy(self._persisted)
            self.staged = copy.deepcopy(self._persisted)
            self.n_boots += 1
            self._restart(boot_s)

    def _restart(self, seconds: float) -> None:
        self._info["initialization_id"] = (self._info["initialization_id"] + 1) % (1 << 24)
        self._ready_s = time.monotonic() + seconds
        self.generation += 1

    def _require_known(self, name: str, value: object) -> None:
        if name not in self.recorded:
            raise Refused(f"there is no parameter {name}")
        if value not in (self.recorded[name], *CHOICES.get(name, (value,))):
            raise Refused(f"{name} cannot be {value!r}")
        if name == "lidar_mode" and value not in self._modes():
            raise Refused(f"lidar_mode cannot be {value!r}, as the capture turns at {self._fps} Hz")
        if name.startswith("udp_port") and not (isinstance(value, int) and 0 < value < 65536):
            raise Refused(f"{name} cannot be {value!r}")
        if name == "azimuth_window" and not _is_window(value):
            raise Refused(f"azimuth_window cannot be {value!r}")

    def _modes(self) -> set[str]:
        return {f"{columns}x{self._fps}" for columns in COLUMNS} | {self.recorded["lidar_mode"]}

    def _format(self) -> dict:
        """lidar_data_format for the configuration that holds."""
        columns = int(self.config["lidar_mode"].partition("x")[0])
        recorded = self._recorded_format
        if self.config["azimuth_window"] == self.recorded["azimuth_window"]:
            first, last = recorded["column_window"]
            was = recorded["columns_per_frame"]
            window = [first * columns // was, (last + 1) * columns // was - 1]
        else:
            window = _column_window(self.config["azimuth_window"], columns)
        shifts = [round(shift * columns / recorded["columns_per_frame"]) for shift in recorded["pixel_shift_by_row"]]
        return recorded | {
            "columns_per_frame": columns,
            "column_window": window,
            "pixel_shift_by_row": shifts,
            "udp_profile_lidar": self.config["udp_profile_lidar"],
        }


def _is_window(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(type(a) is int and 0 <= a <= 360_000 for a in value)


def _column_window(azimuth: list[int], columns: int) -> list[int]:
    """Measurement ids of an azimuth window in millidegrees: they count clockwise, angles the other way round."""
    if (azimuth[1] - azimuth[0]) % 360_000 == 0:
        return [0, columns - 1]
    first, last = ((360_000 - angle) * columns // 360_000 for angle in (azimuth[1], azimuth[0]))
    return [(first + 1) % columns, last % columns]
