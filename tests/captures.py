"""Small captures of an imaginary OS1-32 512x10, written packet by packet, for tests of the drivers."""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from ouster.sdk import core

BEAMS, COLUMNS = 32, 512
SERIAL, INIT_ID = 122300001234, 1629346
START_NS, PERIOD_NS = 5_000_000_000, 100_000_000
HOST_NS = 1_700_000_000_000_000_000
SENSOR_IP, HOST_IP = bytes([10, 5, 5, 9]), bytes([10, 5, 5, 1])
LIDAR_PORT, IMU_PORT = 7502, 7503


def metadata(profile: str = "RNG19_RFL8_SIG16_NIR16", **changes) -> dict:
    """A sensor's metadata; changes: 'section__key=value'."""
    azimuth = np.tile([4.2, 1.4, -1.4, -4.2], BEAMS // 4)
    document = {
        "beam_intrinsics": {
            "beam_altitude_angles": np.linspace(21.2, -21.2, BEAMS).round(2).tolist(),
            "beam_azimuth_angles": azimuth.tolist(),
            "beam_to_lidar_transform": [1, 0, 0, 15.806, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
            "lidar_origin_to_beam_origin_mm": 15.806,
        },
        "calibration_status": {"reflectivity": {"timestamp": "2022-11-29T02:00:08", "valid": True}},
        "config_params": {
            "azimuth_window": [0, 360000],
            "columns_per_packet": 16,
            "lidar_mode": f"{COLUMNS}x10",
            "operating_mode": "NORMAL",
            "timestamp_mode": "TIME_FROM_INTERNAL_OSC",
            "udp_dest": "127.0.0.1",
            "udp_port_imu": IMU_PORT,
            "udp_port_lidar": LIDAR_PORT,
            "udp_profile_imu": "LEGACY",
            "udp_profile_lidar": profile,
        },
        "imu_intrinsics": {
            "imu_to_sensor_transform": [1, 0, 0, -2.4, 0, 1, 0, -9.7, 0, 0, 1, 7.5, 0, 0, 0, 1]
        },
        "lidar_data_format": {
            "column_window": [0, COLUMNS - 1],
            "columns_per_frame": COLUMNS,
            "columns_per_packet": 16,
            "fps": 10,
            "pixel_shift_by_row": np.round(azimuth / 360 * COLUMNS).astype(int).tolist(),
            "pixels_per_column": BEAMS,
            "udp_profile_imu": "LEGACY",
            "udp_profile_lidar": profile,
        },
        "lidar_intrinsics": {
            "lidar_to_sensor_transform": [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]
        },
        "sensor_info": {
            "build_date": "2023-02-03T21:45:40Z",
            "build_rev": "v3.1.0",
            "image_rev": "ousteros-image-prod-bootes-v3.1.0+20230203215650",
            "initialization_id": INIT_ID,
            "prod_line": f"OS-1-{BEAMS}",
            "prod_pn": "840-104682-C",
            "prod_sn": str(SERIAL),
            "status": "RUNNING",
        },
    }
    for name, value in changes.items():
        section, key = name.split("__")
        document[section][key] = value
    return document


def ranges_mm(index: int) -> np.ndarray:
    """(BEAMS, COLUMNS) uint32: what the frame of this index shows, some of it without return."""
    image = 2000 + 8 * np.random.default_rng(index).integers(0, 4000, (BEAMS, COLUMNS))
    image[:, :: 5 + index % 3] = 0
    return image.astype(np.uint32)


def packets(document: dict, indices: range, id_of=lambda index: index) -> list[bytes]:
    """Payloads of one frame for each index, in order; id_of(index): its frame id."""
    info = core.SensorInfo(json.dumps(document))
    payloads = []
    for index in indices:
        frame = core.LidarFrame(info)
        frame.frame_id = id_of(index)
        frame.status[:] = 1
        frame.measurement_id[:] = np.arange(COLUMNS)
        frame.timestamp[:] = START_NS + index * PERIOD_NS + np.arange(COLUMNS) * (PERIOD_NS // COLUMNS)
        frame.packet_timestamp[:] = 1000  # not zero: the SDK leaves out packets that have none
        frame.field("RANGE")[:] = ranges_mm(index)
        frame.field("REFLECTIVITY")[:] = index + 1
        made = core.frame_to_packets(frame, core.PacketFormat.from_info(info), info.init_id, info.sn)
        payloads += [bytes(packet.buf) for packet in made]
    return payloads


@dataclass
class Pcap:
    """A pcap file to be: datagrams split as an Ethernet splits them."""

    mtu: int = 1500
    records: list[bytes] = field(default_factory=list)
    link_type: int = 1
    _identity: int = 0

    def add(self, payload: bytes, port: int = LIDAR_PORT, source: bytes = SENSOR_IP) -> "Pcap":
        """Appends one datagram, as one record for each of its fragments."""
        self._identity = (self._identity + 1) % 65536
        datagram = struct.pack(">HHHH", port, port, len(payload) + 8, 0) + payload
        step = (self.mtu - 20) // 8 * 8
        for at in range(0, len(datagram), step):
            part = datagram[at : at + step]
            flags = at // 8 | (0x2000 if at + step < len(datagram) else 0)
            header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), self._identity, flags, 64, 17, 0)
            self.records.append(b"\0" * 12 + b"\x08\x00" + header + source + HOST_IP + part)
        return self

    def add_all(self, payloads: list[bytes], port: int = LIDAR_PORT, source: bytes = SENSOR_IP) -> "Pcap":
        for payload in payloads:
            self.add(payload, port, source)
        return self

    def write(self, path: Path) -> Path:
        """Writes a pcap file, records 100 us apart."""
        with path.open("wb") as file:
            file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, self.link_type))
            for index, record in enumerate(self.records):
                seconds, fraction = divmod(HOST_NS // 1000 + index * 100, 1_000_000)
                file.write(struct.pack("<IIII", seconds, fraction, len(record), len(record)) + record)
        return path


def write_capture(folder: Path, document: dict, payloads: list[bytes], name: str = "walk") -> Path:
    """A pcap with its metadata beside it."""
    (folder / f"{name}.json").write_text(json.dumps(document))
    return Pcap().add_all(payloads).write(folder / f"{name}.pcap")
