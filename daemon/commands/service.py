"""Commands about the service: run, status, doctor, install-service, uninstall-service."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import click

from ..config import ConfigError, load_config
from .options import CONFIG

NOT_RUNNING = 3  # as systemctl's


@click.command()
@click.option("--source", help="The sensor's host name or address; else sensor.address of the settings.")
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    help="Data directory; under systemd $STATE_DIRECTORY without it.",
)
@CONFIG
def run(source: str | None, data: Path | None, config_path: Path | None) -> None:
    """Run the daemon: read a sensor until stopped, and tell what has changed.

    It starts without the sensor and waits for it. SIGTERM and Ctrl-C end it within ten seconds; SIGHUP reads the
    sections detection and storage of the settings again.

    \b
    Examples:
      revisitd run --source os-122201000998.local --data ~/patrol
      revisitd run --config /etc/revisitd/revisitd.toml
    """
    from ..service import Service

    config = load_config(config_path)
    address = source or config.sensor.address
    if not address:
        raise ConfigError(f"{config_path or 'settings'}: sensor.address is empty: give the sensor's, or --source")
    state = os.environ.get("STATE_DIRECTORY")
    if data is None and state is None:
        raise click.UsageError("give the data directory with --data")
    logging.getLogger().setLevel(min(logging.getLogger().level, logging.INFO))
    Service(data or Path(state), address, config, config_path).run()


@click.command()
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    help="Of the daemon that writes to this data directory; without it, of the system's service.",
)
@click.option("--json", "as_json", is_flag=True, help="For programs.")
@click.pass_context
def status(ctx: click.Context, data: Path | None, as_json: bool) -> None:
    """Say how the running daemon fares; exit code 3 where none runs."""
    from ..status import NotRunning, read_status, status_table

    try:
        found = read_status(data)
        text = json.dumps(found, indent=1) if as_json else status_table(found)
    except NotRunning as why:
        click.echo(f"Error: {why}", err=True)
        ctx.exit(NOT_RUNNING)
    click.echo(text)


@click.command()
@click.argument("host", required=False)
@click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("/var/lib/revisitd"),
    show_default=True,
    help="Data directory.",
)
@CONFIG
@click.pass_context
def doctor(ctx: click.Context, host: str | None, data: Path, config_path: Path | None) -> None:
    """Look whether all that revisitd needs is there, and say how to mend what is not; exit code 1 if anything fails.

    HOST is the sensor; without it, sensor.address of the settings, or this machine alone.
    """
    from ..doctor import examine

    config, failed = load_config(config_path), False
    for finding in examine(host or config.sensor.address, data, config):
        click.echo(f"{finding.verdict:5s} {finding.subject:15s} {finding.found}")
        if finding.mend:
            click.echo(f"{'':21s} -> {finding.mend}")
        failed |= finding.verdict == "fail"
    ctx.exit(int(failed))


ROOT = click.option(
    "--root",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("/"),
    help="Write below this folder, for an image being made, and run nothing.",
)


@click.command("install-service")
@click.option("--source", required=True, help="The sensor's host name or address.")
@click.option("--start/--no-start", default=True, show_default=True, help="Now and at each boot.")
@ROOT
def install_service(source: str, start: bool, root: Path) -> None:
    """Install revisitd as a systemd service (as root): unit, user, kernel's buffer size, settings.

    Settings that are there already are kept.
    """
    from ..install import install

    for line in install(source, root, start):
        click.echo(line)


@click.command("uninstall-service")
@ROOT
def uninstall_service(root: Path) -> None:
    """Stop the service and remove its unit; settings and data stay."""
    from ..install import uninstall

    for line in uninstall(root):
        click.echo(line)
