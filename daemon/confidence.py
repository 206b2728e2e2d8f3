"""How likely a detected object is a true change: a logistic regression on its evidence.

Fitted and tested by tests/benchmarks/confidence.py on virtual patrols, on objects that a detector with its gates
nearly open reports; the weights are those that it printed.
"""

from __future__ import annotations

import numpy as np

from .detection.results import DetectedObject

WEIGHTS = (0.59, 2.61, -0.15, -2.24, -5.35)
CERTAIN = 0.99  # what a model fitted on virtual worlds may say of the real one, at most


def features(found: DetectedObject) -> tuple[float, ...]:
    """Confirmed points, scans that met it, scans that looked through its place (logarithms); share confirmed; 1."""
    return (
        float(np.log(found.n_confirmed)),
        float(np.log(found.n_seen_by)),
        float(np.log(found.n_confirming)),
        found.n_confirmed / len(found.points),
        1.0,
    )


def confidence(found: DetectedObject) -> float:
    """Probability from 0 to CERTAIN."""
    return min(CERTAIN, float(1.0 / (1.0 + np.exp(-np.dot(WEIGHTS, features(found))))))
