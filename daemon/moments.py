"""Times that compare across sessions: each sensor's clock may begin anew with its power."""

from __future__ import annotations

import numpy as np


def in_order(session: np.ndarray, stamp_ns: np.ndarray) -> np.ndarray:
    """Moments (N,) int64 of scans of sessions (N,), which grow with time, at sensor times stamp_ns (N,) int64.

    The oldest session's are its sensor times; each later session's are shifted behind the one before it, so that
    order, and the seconds between two scans of one session, are kept.
    """
    moments = stamp_ns.copy()
    end = None
    for one in np.unique(session):
        of_session = session == one
        if end is not None:
            moments[of_session] += max(0, end + 1 - int(stamp_ns[of_session].min()))
        end = int(moments[of_session].max())
    return moments
