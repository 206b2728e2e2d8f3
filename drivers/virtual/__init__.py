"""A virtual OS1 in virtual worlds: captures with ground truth, for demos, settings, training and tests.

Needs the extra [sim] (Embree).
"""

from .capture import Capture, simulate
from .scenarios import SCENARIOS, Scenario, Staged

__all__ = ["SCENARIOS", "Capture", "Scenario", "Staged", "simulate"]
