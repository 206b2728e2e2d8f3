"""The causes for which something a source saw does not end up in a frame; each source counts them."""

from enum import Enum


class Loss(str, Enum):
    """One cause. Records are network packets in a capture; packets are the sensor's UDP datagrams."""

    TRUNCATED_RECORD = "truncated record"  # the file ends within it
    DAMAGED_RECORD = "damaged record"  # its length is impossible; what follows cannot be read
    CUT_RECORD = "cut record"  # the recorder kept only its beginning (snap length)
    NOT_UDP = "not UDP"
    LOST_FRAGMENT = "lost fragment"  # a packet that the network split, and a part is missing
    OTHER_PORT = "other port"
    OTHER_SENSOR = "other sensor"  # another serial
    OTHER_INIT_ID = "other init id"  # the same sensor, but restarted or reconfigured since the metadata
    WRONG_SIZE = "wrong size"
    WRONG_COLUMN = "wrong column"  # beyond those of a rotation: recorded in another lidar mode
    BAD_CHECKSUM = "bad checksum"
    IMU_PACKET = "IMU packet"  # not used
    ZONE_PACKET = "zone packet"  # not used
    SKIPPED_FRAME = "frame skipped"  # the program was too slow for a live sensor
    OVERFLOW = "packet buffer full"  # it was much too slow
    LATE_PACKET = "late packet"  # came after its frame was finished
    RESTARTED = "frame ids restarted"  # a looped or joined capture: a new frame is begun
    EMPTY_FRAME = "frame without columns"

    def __str__(self) -> str:
        return self.value
