"""What a running stream suffers from, told from its counted losses."""

import time
from collections import Counter

from .losses import Loss

WINDOW_S = 2.0
MANY = 5  # packets, or frames, in a window; a single one says little
COMPLAINTS = {
    Loss.BAD_CHECKSUM: "packets fail their checksum: check cable and network switch",
    Loss.OTHER_SENSOR: "packets of another sensor come to the same UDP port: give each sensor a port of its own",
    Loss.OTHER_INIT_ID: "packets come from before the sensor's last restart, or of another sensor with its serial",
    Loss.WRONG_SIZE: "packets of another profile or sender come to the same UDP port",
    Loss.WRONG_COLUMN: "packets of another lidar mode come to the same UDP port",
    Loss.SKIPPED_FRAME: "frames are skipped, as this machine is too slow for the sensor",
    Loss.OVERFLOW: "packets are dropped, as this machine is much too slow for the sensor",
}


class FaultWatch:
    """Compares the losses of a running source with those of a while before."""

    def __init__(self, losses: Counter):
        self._losses = losses
        self._before: Counter = losses.copy()
        self._due_s = time.monotonic() + WINDOW_S
        self._complaint: Loss | None = None

    def problem(self) -> str:
        """One line on the worst fault of the last window; it stays until a window is free of that fault."""
        if time.monotonic() >= self._due_s:
            suffered = {cause: self._losses[cause] - self._before[cause] for cause in COMPLAINTS}
            if not suffered.get(self._complaint):
                worst = max(suffered, key=suffered.get)
                self._complaint = worst if suffered[worst] >= MANY else None
            self._before = self._losses.copy()
            self._due_s = time.monotonic() + WINDOW_S
        return COMPLAINTS.get(self._complaint, "")
