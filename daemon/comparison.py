"""What the detection thread asks of the detection process, and what it gets back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .detection.results import Detection, Erasure, KnownChange, KnownState, Thresholds

MIN_SCANS = 4  # a submap of fewer says too little: most false changes come from visits that only touch a scene


@dataclass(frozen=True, eq=False)
class Selection:
    """The scans of one side that may be used, and which of them represent it.

    session (S,), scan_id (S,), visit (S,) and moment (S,) int64, times in order over all sessions (moments.py);
    position_m (S, 3) map frame; chosen (S,) bool: the submap's.
    """

    session: np.ndarray
    scan_id: np.ndarray
    visit: np.ndarray
    moment: np.ndarray
    position_m: np.ndarray
    chosen: np.ndarray

    def only(self, keep: np.ndarray) -> Selection:
        """Some of the scans, by indices or (S,) bool."""
        return Selection(**{name: column[keep] for name, column in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Job:
    """What to compare."""

    cumulative: Selection
    recent: Selection
    erasures: list[Erasure]  # removed objects, known before the visit
    known: list[KnownChange]  # changes that held before the visit
    range_m: float
    thresholds: Thresholds


@dataclass(frozen=True, eq=False)
class ScanFacts:
    """What the record of a change needs of each scan of a submap, by its moment."""

    session: dict[int, int]
    stamp_ns: dict[int, int]  # the session's sensor time
    host_ns: dict[int, int]
    residual_m: float  # mean over the scans


@dataclass(frozen=True, eq=False)
class Comparison:
    """What came of it."""

    detection: Detection
    known: list[KnownState]  # what the visit saw of the job's known changes, in their order
    cumulative: ScanFacts
    recent: ScanFacts
    n_points_cumulative: int  # compared: within range, and not known to be gone
    n_points_recent: int
    seconds: dict[str, float]
