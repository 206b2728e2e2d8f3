"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path

import click

DATA = click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Data directory: scans, index and changes.",
)
CONFIG = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), help="Settings (TOML); defaults without it."
)
