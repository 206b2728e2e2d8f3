"""A sensor on the network -> Frames. Its packets wait in the SDK's own thread while Python is busy."""

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from ouster.sdk.core import LidarPacket
from ouster.sdk.sensor import SensorPacketSource

from .beside import read_metadata
from .errors import BadMetadata, SensorUnavailable
from .frame import Frame
from .losses import Loss
from .metadata import parse_metadata, sensor_from_info
from .packets import FrameAssembler, PacketFilter
from .sensor_http import SensorHttp, host_of, local_address, prepare_sensor
from .source import Source

BUFFER_S = 1.0  # odometry holds the GIL for up to 0.25 s; without a buffer 40 % of the columns are lost then
POLL_S = 0.2  # how soon a stop is noticed
RESTART_PACKETS = 64  # so many in a row with another init id: the sensor was restarted


class LiveSource(Source):
    """Frames as they are measured, until stopped.

    address: host name or IP, optionally with the HTTP port. meta: the sensor's metadata, where it must not be
    asked and configured. stop: ends the iteration. timeout_s: silence after which iterating raises
    SensorUnavailable; None waits for ever. After SensorUnavailable, open a new source.
    """

    def __init__(
        self,
        address: str,
        meta: Path | None = None,
        stop: threading.Event | None = None,
        timeout_s: float | None = None,
    ):
        self._host = host_of(address)
        self._stop = stop or threading.Event()
        self._timeout_s = timeout_s
        self.losses: Counter = Counter()
        if meta:
            local_address(address)  # whether there is such a host
            text = read_metadata(meta).text
        else:
            text = json.dumps(prepare_sensor(SensorHttp(address), self._stop))
        self._info = parse_metadata(text)
        self.sensor = sensor_from_info(self._info, text)
        self._filter = PacketFilter(self._info)
        if not self._filter.port:
            raise BadMetadata(f"the metadata of {address} names no udp_port_lidar to listen at")
        try:
            self._packets = SensorPacketSource(self._host, sensor_info=[self._info], buffer_time_sec=BUFFER_S)
        except RuntimeError as error:
            raise SensorUnavailable(
                f"cannot listen at UDP port {self._filter.port} for {address} ({error}): "
                "is another program listening there?"
            ) from None

    def __iter__(self) -> Iterator[Frame]:
        assembler = FrameAssembler(self._info, self.losses)
        for packet in self._lidar_packets():
            for lidar_frame in assembler.add(packet):
                yield from self._frames(lidar_frame)

    def close(self) -> None:
        self._packets.close()

    def _lidar_packets(self) -> Iterator[LidarPacket]:
        heard, n_foreign = time.monotonic(), 0
        while not self._stop.is_set():
            event = self._packets.get_packet(POLL_S)
            kind = event.type.name  # the SDK exports no name for the enum
            if kind == "Packet":
                heard = time.monotonic()
                fault = self._fault(event.packet())
                if not fault:
                    yield event.packet()
                n_foreign = n_foreign + 1 if fault == Loss.OTHER_INIT_ID else 0
                if n_foreign >= RESTART_PACKETS:
                    raise SensorUnavailable(f"sensor {self._host} was restarted or reconfigured: reopen it")
            elif kind in ("Exit", "Error"):
                return
            elif self._timeout_s and time.monotonic() - heard > self._timeout_s:
                raise SensorUnavailable(
                    f"sensor {self._host} has sent nothing to UDP port {self._filter.port} for "
                    f"{self._timeout_s:g} s: check its udp_dest and the firewall"
                )

    def _fault(self, packet) -> Loss | None:
        self.losses[Loss.OVERFLOW] += self._packets.dropped_packets - self.losses[Loss.OVERFLOW]
        if not isinstance(packet, LidarPacket):
            self.losses[Loss.IMU_PACKET] += 1
            return Loss.IMU_PACKET
        fault = self._filter.fault(packet.buf, self._filter.port)
        if fault:
            self.losses[fault] += 1
        return fault
