"""The change manager (CDSD section III-D): detected objects become change objects, each physical change one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..storage.changerows import Change, ChangeObject, Observation
from ..storage.changes import ChangeStore
from .confidence import confidence
from .detection.results import ERASE_M, DetectedObject, Erasure, KnownChange, KnownState
from .worker import Instance

TOUCH_M = 0.4  # objects nearer than the cluster distance are one
MIN_SEEN_SHARE = 0.25  # of a known change's points; a visit that saw less of it says nothing
UNDONE_SHARE = 0.8  # of what was seen; leaves and pose errors undo a fifth of anything
MIN_TOUCH_SHARE = 0.15  # ... in different intervals if so much of the smaller one touches: neighbours stay two


@dataclass(frozen=True)
class Finding:
    """Where and by what a change was found."""

    map_id: int
    session: int
    scene: int
    visit: int
    after_host_ns: int
    before_session: int
    alignment_residual_m: float
    model_id: str
    config_digest: str


class ChangeManager:
    """Adds what a detection found to the store, and answers planners."""

    def __init__(self, store: ChangeStore):
        self._store = store

    def record(self, found: DetectedObject, finding: Finding) -> bool:
        """Store a detected object; False when the store has this change already (it is completed, not doubled).

        The same change seen from a neighbouring scene or on a later visit touches one of its polarity that still
        holds. One that it undoes (what appeared has gone again) is marked as ended by it.
        """
        touching = self._touching(found.points, finding.map_id)
        sure, evidence = confidence(found), _evidence(found)
        same = [(c, share) for c, share in touching if c.polarity == found.polarity and c.state == "present"]
        # Of the same interval: another view of the same moment. However little of the two touches, they are one.
        old = finding.before_session, found.before_ns
        views = [c for c, _ in same if c.session == finding.session and old < (c.session, c.first_seen_ns)]
        if views:
            views.sort(key=lambda change: -change.n_points)
            known, parts = views[0], views[1:]
            self._store.extend(known.id, found.points, max(sure, known.confidence), evidence)
            for part in parts:
                self._store.merge(part.id, known.id)
            self._observe(known, "still", found, finding)
            return False
        again = [c for c, share in same if share >= MIN_TOUCH_SHARE]
        if again:
            self._observe(max(again, key=lambda change: change.n_points), "still", found, finding)
            return False
        change_id = self._store.add(_change(found, finding, sure, evidence))
        for other, share in touching:
            # Only what was there before: a door that opens disappears here and appears beside in one interval.
            older = (other.session, other.first_seen_ns) <= old
            if older and share >= MIN_TOUCH_SHARE:
                self._observe(other, "gone", found, finding, superseded_by=change_id)
        return True

    def publish_change_list(self, n: int) -> list[ChangeObject]:
        """Metadata of all changes of at least n points."""
        return self._store.publish_change_list(n)

    def update_map(self, points: np.ndarray, taken: np.ndarray, map_id: int, until: tuple[int, int]) -> np.ndarray:
        """Which points (N, 3) float32 of older scans still stand, by all that was known to be gone at a time.

        taken (N, 2) int64: session and sensor time of each point's scan; until: session and sensor time.
        """
        from .detection.erasure import standing  # compiled loops: not for the process of the frame loop

        box = points.min(axis=0), points.max(axis=0)
        return standing(points, np.arange(len(points)), taken, self.erasures(map_id, box, until))

    def erasures(self, map_id: int, box: tuple[np.ndarray, np.ndarray], until: tuple[int, int]) -> list[Erasure]:
        """Removed objects in a box (lower and upper corner (3,), metres, map frame), first seen gone before a time.

        What update_map (detection/erasure.py) takes away. until: session and sensor time.
        """
        lower, upper = box
        gone = self._store.changes(
            polarity="disappeared", map_id=map_id, box=(lower - ERASE_M, upper + ERASE_M), before=until
        )
        return [Erasure(change.points, change.session, change.first_seen_ns) for change in gone]

    def known(self, map_id: int, box: tuple[np.ndarray, np.ndarray], before: tuple[int, int]) -> list[KnownChange]:
        """Changes in a box that hold, first seen before a time (session, sensor time): what a visit is asked about."""
        held = self._store.changes(map_id=map_id, box=box, before=before)
        return [KnownChange(c.id, c.polarity, c.points) for c in held if c.state == "present"]

    def note(self, states: list[KnownState], instance: Instance) -> None:
        """Write down what the visit of an instance saw of the changes known before it.

        What the detection of the same visit found to have ended, or found again, has its entry already. One whose
        place is seen to be as before, though too little of it for a change of its own, has ended too.
        """
        visit = instance.session_id, instance.scene_id, instance.visit
        for state in states:
            if self._store.whole_of(state.change_id) != state.change_id:
                continue  # this visit has found it to be a part of another
            change = self._store.get(state.change_id, with_points=False)
            last = self._store.history(state.change_id)[-1]
            if change.state != "present" or (last["session_id"], last["scene_id"], last["visit"]) == visit:
                continue
            seen = Observation(_seen_as(state), *visit, instance.t_out_ns, state.share_still, state.share_undone)
            # That a neighbouring scene does not see a thing is no news; that its own does not, is.
            if seen.kind != "unseen" or change.scene == instance.scene_id:
                self._store.observe(state.change_id, seen)

    def _touching(self, points: np.ndarray, map_id: int) -> list[tuple[ChangeObject, float]]:
        """Changes that no other change undid and that touch the points; and the share of the smaller that touches."""
        box = points.min(axis=0) - TOUCH_M, points.max(axis=0) + TOUCH_M
        near = self._store.changes(map_id=map_id, box=box)
        shares = [(c, _touch_share(c.points, points)) for c in near if c.superseded_by is None]
        return [(c, share) for c, share in shares if share > 0.0]

    def _observe(
        self, change: ChangeObject, kind: str, found: DetectedObject, finding: Finding, superseded_by: int | None = None
    ) -> None:
        seen = Observation(kind, finding.session, finding.scene, finding.visit, found.after_ns)
        self._store.observe(change.id, seen, superseded_by)


def _seen_as(state: KnownState) -> str:
    seen = state.share_still + state.share_undone
    if seen < MIN_SEEN_SHARE:
        return "unseen"
    if state.share_undone >= UNDONE_SHARE * seen:
        return "gone"
    return "still" if state.share_still > state.share_undone else "unseen"


def _touch_share(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the smaller point set that lies within TOUCH_M of the other."""
    small, large = (a, b) if len(a) <= len(b) else (b, a)
    distance, _ = cKDTree(large).query(small, distance_upper_bound=TOUCH_M)
    return float(np.isfinite(distance).mean())


def _evidence(found: DetectedObject) -> dict[str, float]:
    return {
        "points_confirmed": found.n_confirmed,
        "share_confirmed": round(found.n_confirmed / len(found.points), 3),
        "scans_showing_it": found.n_seen_by,
        "scans_looking_through": found.n_confirming,
        "beyond_tau_m": round(found.beyond_tau_m, 3),
    }


def _change(found: DetectedObject, finding: Finding, sure: float, evidence: dict[str, float]) -> Change:
    return Change(
        polarity=found.polarity,
        map_id=finding.map_id,
        session=finding.session,
        scene=finding.scene,
        visit=finding.visit,
        first_seen_ns=found.after_ns,
        first_seen_host_ns=finding.after_host_ns,
        points=found.points,
        confidence=sure,
        evidence=evidence,
        alignment_residual_m=finding.alignment_residual_m,
        model_id=finding.model_id,
        config_digest=finding.config_digest,
        last_before_session=finding.before_session,
        last_before_ns=found.before_ns,
    )
