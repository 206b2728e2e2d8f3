"""What goes into the detector beside the submaps, and what comes out. Light: the frame loop's process imports it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ERASE_M = 0.3  # a removed object's points are erased from older scans within tau of what was seen of it


@dataclass(frozen=True)
class Thresholds:
    """The detector's parameters; names, units and sources as in the settings' section [detection]."""

    tau_m: float
    n: int
    rho_m: float
    ground_sigmas: float
    ground_min_sigma_m: float
    occlusion_range_m: float
    occlusion_margin_m: float
    min_confirming_scans: int
    min_showing_scans: int
    min_showing_s: float
    cluster_distance_m: float
    min_points: int
    ground_filter_c1_m: float
    ground_filter_c2: float


@dataclass(frozen=True, eq=False)
class KnownChange:
    """A change that held before the visit: what does the visit see of it? points (N, 3) float32, map frame."""

    change_id: int
    polarity: str
    points: np.ndarray


@dataclass(frozen=True)
class KnownState:
    """What a visit saw of a known change, as shares of its points; the rest it did not see."""

    change_id: int
    share_still: float  # in the state that the change left
    share_undone: float  # in the state before it


@dataclass(frozen=True, eq=False)
class Erasure:
    """A removed object: points (N, 3) that older scans still show, and since when it is gone."""

    points: np.ndarray
    session: int
    gone_ns: int


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """One change: its points (N, 3) float32 map frame, one for each 5 cm voxel, and the evidence for it."""

    polarity: str  # "appeared" or "disappeared"
    points: np.ndarray
    before_ns: int  # last scan that showed the old state
    after_ns: int  # first scan that showed the new one
    n_confirmed: int  # points whose place the other visit looked through
    n_seen_by: int  # scans of its own submap that saw it
    n_confirming: int  # scans of the other submap that looked through its place
    beyond_tau_m: float  # how far beyond tau its confirmed points are from the other submap, median; below 0: within


@dataclass(frozen=True, eq=False)
class Detection:
    """Result of one instance: the objects, points left after each step, and seconds for each step."""

    objects: list[DetectedObject]
    n_candidates: int
    n_confirmed: int
    seconds: dict[str, float]
