"""A virtual sensor on the network: it plays a capture, answers HTTP as a sensor does, and fails as it is told to.

Run it in a process of its own: the SDK's live source holds the GIL, and would stop a sensor in the same one.
"""

from .emulator import Emulator, Faults

__all__ = ["Emulator", "Faults"]
