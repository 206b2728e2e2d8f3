"""Commands about the settings."""

from __future__ import annotations

from pathlib import Path

import click

from ..config import dump_config, load_config
from .options import CONFIG


@click.command("check-config")
@click.argument("path", type=click.Path(path_type=Path))
def check_config(path: Path) -> None:
    """Check a settings file; exit code 78 and a line for each problem where it is wrong."""
    load_config(path)
    click.echo(f"{path}: ok")


@click.command("dump-config")
@CONFIG
def dump_config_(config_path: Path | None) -> None:
    """Print all settings with units, defaults and reasons, as TOML."""
    click.echo(dump_config(load_config(config_path)), nl=False)
