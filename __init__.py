"""revisitd: online geometric change detection for robots with an Ouster OS1 (CDSD)."""

__version__ = "0.1.0"
