"""Frames of the virtual sensor -> genuine Ouster packets, with CRC and host times."""

import numpy as np
from ouster.sdk.core import LidarFrame, PacketFormat, SensorInfo, frame_to_packets

BOOT_NS = 20_000_000_000  # the sensor's clock at the first column: it counts from its start
HOST_EPOCH_NS = 1_760_000_000_000_000_000  # the host's clock at the sensor's zero
LATENCY_NS = 300_000  # from the last column of a packet to the host
MASKS = {  # bits of a field that a profile carries, where they are fewer than the field's type has
    "RNG15_RFL8_NIR8": {"RANGE": 0x3FFF8, "NEAR_IR": 0xFF0},
    "RNG15_RFL8_NIR8_DUAL": {"RANGE": 0x3FFF8, "NEAR_IR": 0xFF0},
}
PROFILES = (
    "RNG19_RFL8_SIG16_NIR16",
    "RNG15_RFL8_NIR8",
    "RNG19_RFL8_SIG16_NIR16_DUAL",
    "RNG15_RFL8_NIR8_DUAL",
    "LEGACY",
)


class Encoder:
    """Makes one sensor's packets."""

    def __init__(self, metadata: str):
        self.info = SensorInfo(metadata)
        self._format = PacketFormat.from_info(self.info)
        self._mask = MASKS.get(str(self.info.format.udp_profile_lidar), {})
        self.width = self.info.format.columns_per_frame
        self.period_ns = round(1e9 / self.info.format.fps)

    def column_ns(self, index: int) -> np.ndarray:
        """(W,) int64 sensor clock of the columns of frame `index`."""
        return BOOT_NS + index * self.period_ns + np.arange(self.width, dtype=np.int64) * self.period_ns // self.width

    def frame(self, index: int, fields: dict[str, np.ndarray]) -> LidarFrame:
        """fields: name -> (H, W); those that the profile lacks are left out. A second return is empty."""
        frame = LidarFrame(self.info)
        frame.frame_id = index + 1
        frame.status[:] = 1
        frame.measurement_id[:] = np.arange(self.width)
        stamp = self.column_ns(index)
        frame.timestamp[:] = stamp.astype(np.uint64)
        last = stamp.reshape(-1, self.info.format.columns_per_packet)[:, -1]
        # Whole microseconds: that is what a pcap keeps.
        frame.packet_timestamp[:] = ((HOST_EPOCH_NS + last + LATENCY_NS) // 1000 * 1000).astype(np.uint64)
        for name in frame.fields:
            if name in fields:
                frame.field(name)[:] = fields[name] & np.asarray(self._mask.get(name, -1)).astype(fields[name].dtype)
        return frame

    def packets(self, frame: LidarFrame) -> list:
        """The frame's LidarPackets, in order."""
        return frame_to_packets(frame, self._format, self.info.init_id, int(self.info.sn))
