"""Which metadata belongs to a capture: the file given, or one beside it that its packets confirm."""

from dataclasses import dataclass
from pathlib import Path

from ouster.sdk import core

from .errors import BadCapture, BadMetadata, DriverError, SourceNotFound
from .metadata import parse_metadata
from .packets import PacketFilter
from .survey import Survey, Verdict

MOST_CANDIDATES = 100
MOST_METADATA_BYTES = 4 << 20
BEAM_KEY = "beam_altitude_angles"  # in all metadata; not in digests and the like that lie beside it


@dataclass(frozen=True)
class Metadata:
    """A metadata file, read."""

    path: Path
    text: str
    info: core.SensorInfo


def read_metadata(path: Path) -> Metadata:
    """Raises SourceNotFound, or BadMetadata with the file's name and what is wrong in it."""
    try:
        if path.stat().st_size > MOST_METADATA_BYTES:
            raise BadMetadata(f"{path} is no metadata: {path.stat().st_size} bytes; give the sensor's JSON")
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise BadMetadata(f"{path} is no metadata: it is not text; give the sensor's JSON") from None
    except OSError as error:
        raise SourceNotFound(f"metadata {path} cannot be read: {error.strerror}") from None
    try:
        return Metadata(path, text, parse_metadata(text))
    except BadMetadata as error:
        raise BadMetadata(f"{path}: {error}") from None


def match_metadata(capture: Path, meta: Path | None) -> tuple[Metadata, Survey, Verdict]:
    """The metadata of a capture, given or found, with the first look at its packets.

    Raises BadCapture where the capture is of no use, BadMetadata where metadata and packets do not belong
    together, SourceNotFound where no metadata is found.
    """
    named = meta or capture.with_suffix(".json")
    if meta or named.exists():
        return _match_named(capture, named)
    return _match_beside(capture)


def _match_named(capture: Path, path: Path) -> tuple[Metadata, Survey, Verdict]:
    try:
        metadata, fault = read_metadata(path), None
    except DriverError as error:
        metadata, fault = None, error
    survey = Survey(capture, [PacketFilter(metadata.info)] if metadata else [])
    survey.require_packets()  # an empty capture is the plainer truth
    if fault:
        raise type(fault)(f"{fault}; {capture} holds {survey.seen()}")
    verdict = survey.verdicts[0]
    if not verdict.fits:
        raise survey.error(verdict, path.name)
    survey.require_one_sender(verdict)
    return metadata, survey, verdict


def _match_beside(capture: Path) -> tuple[Metadata, Survey, Verdict]:
    candidates, unusable = _candidates(capture)
    survey = Survey(capture, [PacketFilter(candidate.info) for candidate in candidates])
    survey.require_packets()
    unfit = [type(error)(f"{error}; {capture} holds {survey.seen()}") for error in unusable]
    fitting, doubtful = [], []
    for candidate, verdict in zip(candidates, survey.verdicts, strict=True):
        related = _is_related(capture, candidate.path)
        if verdict.fits and (related or verdict.filter.has_ids):
            fitting.append((candidate, verdict))
        elif verdict.fits:
            doubtful.append(candidate.path.name)
        elif related:
            unfit.append(survey.error(verdict, candidate.path.name))
    if len({_identity(candidate.info) for candidate, _ in fitting}) > 1:
        names = ", ".join(candidate.path.name for candidate, _ in fitting)
        raise BadMetadata(f"{capture} fits several metadata files, give the right one with --meta: {names}")
    if not fitting:
        raise _nothing_beside(capture, survey, doubtful, unfit)
    survey.require_one_sender(fitting[0][1])
    return fitting[0][0], survey, fitting[0][1]


def _candidates(capture: Path) -> tuple[list[Metadata], list[DriverError]]:
    """All metadata in the capture's folder, and what is wrong with that which is named like it."""
    candidates, unusable = [], []
    for path in sorted(capture.parent.glob("*.json"))[:MOST_CANDIDATES]:
        try:
            candidates.append(read_metadata(path))
        except DriverError as error:
            if _is_related(capture, path) and BEAM_KEY in path.read_text(errors="replace"):
                unusable.append(error)
    return candidates, unusable


def _nothing_beside(
    capture: Path, survey: Survey, doubtful: list[str], unfit: list[DriverError]
) -> DriverError:
    if unfit:
        return unfit[0]
    if not survey.has_ouster_packets:
        return BadCapture(f"{capture} holds no lidar packets of an Ouster sensor: seen {survey.seen()}")
    maybe = f" ({', '.join(doubtful)} may be it, but LEGACY packets carry no serial)" if doubtful else ""
    return SourceNotFound(
        f"no metadata of {capture} is beside it, neither {capture.stem}.json nor another that its packets "
        f"confirm{maybe}: give it with --meta; seen {survey.seen()}"
    )


def _is_related(capture: Path, metadata: Path) -> bool:
    """Whether they are named like OS-1_lb_n3.pcap and OS-1.json, or walk.pcap and walk_0.json."""
    shorter, longer = sorted((capture.stem, metadata.stem), key=len)
    return longer.startswith(shorter)


def _identity(info: core.SensorInfo) -> tuple:
    return info.sn, info.init_id, str(info.format.udp_profile_lidar), str(info.config.lidar_mode)
