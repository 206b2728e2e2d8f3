"""Who else sends to the sensor's UDP port: the SDK leaves those packets out, and tells nobody."""

import os
import select
import socket
import threading
import time
from collections import Counter
from ipaddress import IPv4Address, IPv6Address, ip_address

LOOK_S = 0.02  # between two looks: a wake-up for each packet would cost more than the answer is worth
WAIT_S = 0.1  # how soon a stop is noticed
FEW = 3  # packets; a single stray one says little
QUIET_S = 60.0  # without any, until there is no problem any more


class StrangerWatch:
    """Looks at the senders of packets that wait in the sensor's socket, in a thread of its own, and takes none away.

    It is a sample: the SDK may take a packet before it is looked at. fileno: of the UDP socket; a duplicate is held
    until close(), and the port with it. sensor_ip: whose packets are awaited.
    """

    def __init__(self, fileno: int, sensor_ip: str, port: int):
        self._socket = socket.socket(fileno=os.dup(fileno))
        self._sensor, self._port = _comparable(sensor_ip), port
        self._seen: Counter = Counter()  # sender -> packets, since there was none for QUIET_S
        self._last_s = 0.0
        self._problem = ""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="strangers", daemon=True)
        self._thread.start()

    def problem(self) -> str:
        """One line on who sends here beside the sensor; it stays the same until none does for QUIET_S."""
        if time.monotonic() - self._last_s > QUIET_S:
            self._seen, self._problem = Counter(), ""
        return self._problem

    def close(self) -> None:
        """Ends the watch and lets go of the socket."""
        self._closing.set()
        self._thread.join()
        self._socket.close()

    def _watch(self) -> None:
        waiting = select.poll()
        waiting.register(self._socket, select.POLLIN)
        first_byte = bytearray(1)
        while not self._closing.is_set():
            if not waiting.poll(1000 * WAIT_S):
                continue
            try:
                size, sender = self._socket.recvfrom_into(
                    first_byte, 1, socket.MSG_PEEK | socket.MSG_TRUNC | socket.MSG_DONTWAIT
                )
            except OSError:  # the SDK was faster
                pass
            else:
                self._note(_comparable(sender[0]), size)
            self._closing.wait(LOOK_S)

    def _note(self, sender: IPv4Address | IPv6Address, size: int) -> None:
        if sender == self._sensor:
            return
        self._last_s = time.monotonic()
        self._seen[sender] += 1
        if not self._problem and self._seen.total() >= FEW:
            most = max(self._seen, key=self._seen.get)
            self._problem = (
                f"packets of {most} ({size} bytes) come to UDP port {self._port}; they are left out, as the sensor is "
                f"{self._sensor}: let that sender use another port"
            )


def _comparable(address: str) -> IPv4Address | IPv6Address:
    """Without the network card, and as IPv4 where it is one: a socket for both tells it in the form of IPv6."""
    parsed = ip_address(address.partition("%")[0])
    return getattr(parsed, "ipv4_mapped", None) or parsed
