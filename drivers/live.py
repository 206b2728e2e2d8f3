"""A sensor on the network -> Frames. Its packets wait in the SDK's own thread while Python is busy."""

import copy
import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ouster.sdk.core import LidarPacket, Packet, SensorInfo
from ouster.sdk.sensor import SensorPacketSource

from .beside import read_metadata
from .errors import BadMetadata, SensorChanged, SensorUnavailable
from .frame import Frame
from .losses import Loss
from .metadata import parse_metadata, sensor_from_info
from .packets import FrameAssembler, PacketFilter, packets_per_frame
from .sensor_http import SensorHttp, resolve
from .sensor_setup import AS_IT_IS, SensorWish, prepare_sensor
from .source import Source
from .strangers import StrangerWatch

BUFFER_S = 3.0  # odometry holds the GIL for up to 0.25 s; without a buffer 40 % of the columns are lost then
BACKLOG_S = 1.0  # of packets that wait; beyond, whole frames are skipped: odometry does well with every second one
MOST_SKIPPED = 4  # in a row: over longer gaps the odometry is lost
POLL_S = 0.2  # how soon a stop is noticed
ERROR_PAUSE_S = 0.01
USELESS_PACKETS = 64  # so many in a row that are not the sensor's as it was opened: it is another one now
USELESS = {
    Loss.OTHER_INIT_ID: "it was restarted or reconfigured",
    Loss.OTHER_SENSOR: "what comes is of another sensor",
    Loss.WRONG_SIZE: "what comes is of another profile or sensor",
    Loss.WRONG_COLUMN: "what comes is of another lidar mode",
}


class LiveSource(Source):
    """Frames as they are measured, until stopped.

    address: host name or IP, optionally with the HTTP port. meta: the sensor's metadata, where it must not be
    asked and configured. stop: ends the iteration. timeout_s: silence after which iterating raises
    SensorUnavailable; None waits for ever. losses: counted on, where the sensor was open before. After
    SensorUnavailable, open a new source.
    """

    def __init__(
        self,
        address: str,
        meta: Path | None = None,
        stop: threading.Event | None = None,
        timeout_s: float | None = None,
        wish: SensorWish = AS_IT_IS,
        losses: Counter | None = None,
    ):
        self._address = address
        self._stop = stop or threading.Event()
        self._timeout_s = timeout_s
        self.losses: Counter = Counter() if losses is None else losses
        self.route = resolve(address)
        sensor_ip, our_address = self.route
        if meta:
            text = read_metadata(meta).text
        else:
            text = json.dumps(prepare_sensor(SensorHttp(address), wish, our_address, self._stop))
        self._info = parse_metadata(text)
        self.sensor = sensor_from_info(self._info, text)
        self._filter = PacketFilter(self._info)
        self.port, self.has_ids = self._filter.port, self._filter.has_ids
        if not self.port:
            raise BadMetadata(f"the metadata of {address} names no udp_port_lidar to listen at")
        try:
            self._packets = SensorPacketSource(
                sensor_ip, sensor_info=[_lidar_only(self._info)], buffer_time_sec=BUFFER_S
            )
        except RuntimeError as error:
            raise SensorUnavailable(
                f"cannot listen at UDP port {self.port} for {address} ({error}): is another program listening there?"
            ) from None
        self.strangers = StrangerWatch(self._packets.sockets()[0], sensor_ip, self.port)
        self._overflown = self._useless = 0
        self._frame_id = -1  # of the last packet
        self._skipping, self._n_skipped = False, 0  # that frame, and so many in a row
        self._packets_per_s = packets_per_frame(self._info) * self._info.format.fps

    def __iter__(self) -> Iterator[Frame]:
        for frame in self.listen():
            if frame is not None:
                yield frame

    def listen(self) -> Iterator[Frame | None]:
        """Frames as they come, and None about every POLL_S in which there is none. Ends when stopped.

        Raises SensorChanged where what comes is not of the sensor as it was opened.
        """
        assembler = FrameAssembler(self._info, self.losses)
        heard = told = time.monotonic()  # the time that the reader takes for a frame is not ours
        while not self._stop.is_set():
            packet = self._next_packet()
            if packet is not None:
                heard = time.monotonic()
                for lidar_frame in () if self._is_skipped(packet.frame_id()) else assembler.add(packet):
                    yield from self._frames(lidar_frame)
                    told = time.monotonic()
            elif self._timeout_s and time.monotonic() - heard > self._timeout_s:
                raise SensorUnavailable(
                    f"sensor {self._address} has sent nothing to UDP port {self.port} for "
                    f"{self._timeout_s:g} s: check its udp_dest and the firewall"
                )
            if time.monotonic() - told >= POLL_S:
                yield None
                told = time.monotonic()

    @property
    def backlog_s(self) -> float:
        """Seconds of packets that have come and wait to be read."""
        return self._packets.buffer_size() / self._packets_per_s

    def close(self) -> None:
        self.strangers.close()
        self._packets.close()

    def _is_skipped(self, frame_id: int) -> bool:
        """Whether the frame is left out to catch up: decided at its first packet, so that the others are whole."""
        if frame_id != self._frame_id:
            self._frame_id = frame_id
            self._skipping = self.backlog_s > BACKLOG_S and self._n_skipped < MOST_SKIPPED
            self._n_skipped = self._n_skipped + 1 if self._skipping else 0
            self.losses[Loss.SKIPPED_FRAME] += self._skipping
        return self._skipping

    def _next_packet(self) -> LidarPacket | None:
        """The next packet that is of use, None where none comes within about POLL_S."""
        deadline = time.monotonic() + POLL_S
        while not self._stop.is_set() and time.monotonic() < deadline:
            event = self._packets.get_packet(POLL_S)
            kind = event.type.name  # the SDK exports no name for the enum
            if kind == "Error":  # an empty datagram is one, from whomever
                self._stop.wait(ERROR_PAUSE_S)
            if kind != "Packet":
                continue
            fault = self._fault(event.packet())
            if fault is None:
                self._useless = 0
                return event.packet()
            self._useless += fault in USELESS
            if self._useless >= USELESS_PACKETS:
                raise SensorChanged(f"sensor {self._address} must be opened again: {USELESS[fault]}")
        return None

    def _fault(self, packet: Packet) -> Loss | None:
        self.losses[Loss.OVERFLOW] += self._packets.dropped_packets - self._overflown
        self._overflown = self._packets.dropped_packets
        if not isinstance(packet, LidarPacket):
            self.losses[Loss.IMU_PACKET] += 1
            return Loss.IMU_PACKET
        fault = self._filter.fault(packet.buf, self.port)
        if fault:
            self.losses[fault] += 1
        return fault


def _lidar_only(info: SensorInfo) -> SensorInfo:
    """The same sensor, but its IMU and zone packets' ports are left to other programs."""
    info = copy.deepcopy(info)
    info.config.udp_port_imu = info.config.udp_port_zm = info.config.udp_port_lidar
    return info
