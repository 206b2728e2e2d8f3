"""Input damaged at random, but the same for the same seed, and what the drivers make of it."""

import copy
import json
import random
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from captures import Pcap, metadata, packets
from ouster.sdk import core, osf

from revisitd.drivers.errors import DriverError
from revisitd.drivers.frame import Frame
from revisitd.drivers.gate import FrameGate
from revisitd.drivers.metadata import parse_metadata, sensor_from_info
from revisitd.drivers.ouster import open_source
from revisitd.drivers.packets import FrameAssembler, PacketFilter, frame_from_sdk
from revisitd.drivers.sensor_http import SensorHttp
from revisitd.drivers.sensor_setup import AS_IT_IS, require_unchanged
from revisitd.drivers.telemetry import read_telemetry

PROFILES = ("RNG15_RFL8_NIR8", "RNG19_RFL8_SIG16_NIR16", "RNG15_RFL8_NIR8_DUAL", "LEGACY")
N_FRAMES = 2
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
ODD_VALUES = (
    *(0, -1, 1, 3, 15, 17, 127, 512, 65_536, 10**9, 2**31, 2**63, 2**64, 0.5, 1e308, -1e308),
    *(None, True, "", "x", "LEGACY", "OFF", "9" * 40, "x" * 100_000, "\ud800", "1024x10", "RNG15_RFL8_NIR8_DUAL"),
    *([], {}, [1], [[]], [0] * 1000, float("nan"), float("inf")),
)
LONGEST_COMPLAINT = 1000


def outcome_of(what: str, seed: int) -> str:
    """What comes of one damaged input: "ok" or the name of a DriverError. Any other exception is a bug."""
    rng = random.Random(f"{what} {seed}")
    try:
        MUTANTS[what](rng)
    except DriverError as error:
        assert "\n" not in str(error) and len(str(error)) < LONGEST_COMPLAINT, repr(error)
        return type(error).__name__
    return "ok"


def _packets(rng: random.Random) -> None:
    """Damaged, lost, doubled and shuffled packets into the assembly of frames."""
    document, payloads = _recording(rng.choice(PROFILES))
    info = parse_metadata(json.dumps(document))
    sensor = sensor_from_info(info, "")
    accepts, assembler, gate = PacketFilter(info), FrameAssembler(info, Counter()), FrameGate()
    for payload in _shuffled(rng, payloads):
        damaged = _damaged(rng, payload) if rng.random() < 0.3 else payload
        if accepts.fault(damaged, accepts.port) is None:
            for lidar_frame in assembler.add(assembler.packet(damaged, 1)):
                _use(frame_from_sdk(lidar_frame, sensor), gate)
    for lidar_frame in assembler.flush():
        _use(frame_from_sdk(lidar_frame, sensor), gate)


def _pcap(rng: random.Random) -> None:
    """A damaged pcap file with good metadata beside it."""
    with TemporaryDirectory() as folder:
        document, payloads = _recording(rng.choice(PROFILES))
        path = Path(folder) / "walk.pcap"
        path.with_suffix(".json").write_text(json.dumps(document))
        Pcap(mtu=rng.choice((576, 1500, 65_000))).add_all(payloads).write(path)
        path.write_bytes(_damaged(rng, path.read_bytes()))
        _read(path)


def _metadata(rng: random.Random) -> None:
    """Damaged metadata, and packets that may or may not fit it."""
    document, payloads = _recording(rng.choice(PROFILES))
    info = parse_metadata(_damaged_json(rng, document))
    sensor = sensor_from_info(info, "")
    assert np.isfinite(sensor.direction).all() and np.isfinite(sensor.offset).all()
    accepts, assembler, gate = PacketFilter(info), FrameAssembler(info, Counter()), FrameGate()
    for payload in payloads:
        if accepts.fault(payload, accepts.port or 7502) is None:
            for lidar_frame in assembler.add(assembler.packet(payload, 1)):
                _use(frame_from_sdk(lidar_frame, sensor), gate)


def _osf(rng: random.Random) -> None:
    """A damaged OSF file."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walk.osf"
        path.write_bytes(_damaged(rng, _osf_recording(rng.choice(PROFILES))))
        _read(path)


def _http(rng: random.Random) -> None:
    """What a sensor, or whatever is at its address, may answer."""

    class Answering(SensorHttp):
        def _request(self, path: str, body: bytes | None = None) -> tuple[int, bytes]:
            document = _recording("LEGACY")[0] if "metadata" in path else {"active": [{}], "sensor": {}, "ptp": {}}
            text = _damaged_json(rng, document).encode("utf-8", "replace")
            return 200, _damaged(rng, text) if rng.random() < 0.3 else text

    read_telemetry(Answering("10.5.5.9"))
    require_unchanged(Answering("10.5.5.9"), AS_IT_IS, "10.5.5.1", 1)


MUTANTS: dict[str, Callable[[random.Random], None]] = {
    "packets": _packets,
    "pcap": _pcap,
    "metadata": _metadata,
    "osf": _osf,
    "http": _http,
}


def _use(frame: Frame | None, gate: FrameGate) -> None:
    """What the daemon does first with a frame."""
    if frame is not None and gate.check(frame) is None:
        assert np.isfinite(frame.sensor.points(frame.range_mm)).all()
        assert frame.stamp_ns >= 0 and 0 < frame.valid_ratio <= 1


def _read(path: Path) -> None:
    gate = FrameGate()
    with open_source(str(path)) as source:
        for frame in source:
            _use(frame, gate)
        gate.require_accepted(path.name)


@cache
def _recording(profile: str) -> tuple[dict, list[bytes]]:
    document = metadata(profile)
    return document, packets(document, range(N_FRAMES))


@cache
def _osf_recording(profile: str) -> bytes:
    document, payloads = _recording(profile)
    info = core.SensorInfo(json.dumps(document))
    assembler = FrameAssembler(info, Counter())
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walk.osf"
        with osf.Writer(str(path), info) as writer:
            for payload in payloads:
                for frame in assembler.add(assembler.packet(payload, 1)):
                    writer.save(0, frame)
        return path.read_bytes()


def _damaged(rng: random.Random, content: bytes) -> bytes:
    """The same bytes with some wrong, cut out, doubled or put in."""
    damaged = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 5, 50))):
        if not damaged:
            break
        # Headers, at both ends, say how the rest is read.
        where = rng.choice((len(damaged), min(len(damaged), 128)))
        at = rng.randrange(where) if rng.random() < 0.8 else len(damaged) - 1 - rng.randrange(where)
        size = rng.choice((1, 2, 4, 8, 100, 2000))
        match rng.randrange(7):
            case 0 | 1:
                damaged[at] ^= 1 << rng.randrange(8)
            case 2 | 3:
                value = rng.choice(EXTREMES).to_bytes(8, rng.choice(("little", "big")))
                damaged[at : at + min(size, 8)] = value[: min(size, 8)]
            case 4:
                del damaged[at : at + size]
            case 5:
                damaged[at:at] = rng.choice((damaged[at : at + size], rng.randbytes(size)))
            case 6:
                if rng.random() < 0.2:
                    del damaged[at:]
    return bytes(damaged)


def _shuffled(rng: random.Random, payloads: list[bytes]) -> list[bytes]:
    """Some of them lost, some doubled, some late."""
    places = [
        (number + rng.choice((0, 0, 0, 0, 40)) * rng.random(), payload) for number, payload in enumerate(payloads)
    ]
    places += rng.sample(places, rng.randrange(5))
    for _ in range(rng.randrange(5)):
        places.remove(rng.choice(places))
    return [payload for _, payload in sorted(places, key=lambda place: place[0])]


def _damaged_json(rng: random.Random, document: dict) -> str:
    """The document with entries missing or odd, sometimes not even JSON."""
    document = copy.deepcopy(document)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        holder, key = rng.choice(list(_entries(document)))
        if rng.random() < 0.2:
            del holder[key]
        else:
            holder[key] = copy.deepcopy(rng.choice(ODD_VALUES))
        if not document:
            break
    text = json.dumps(document)
    if rng.random() < 0.05:
        text = text[: rng.randrange(len(text))]
    return text


def _entries(value: object):
    """(container, key) of all that is in a document, to the depth; of a list, its first ones."""
    keys = list(value) if isinstance(value, dict) else range(min(len(value), 4)) if isinstance(value, list) else ()
    for key in keys:
        yield value, key
        yield from _entries(value[key])
