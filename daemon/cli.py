"""Commands. Data goes to stdout, what happens to stderr; each kind of error has its exit code."""

from __future__ import annotations

import logging

import click

from .. import __version__
from ..drivers.errors import BadCapture, BadMetadata, DriverError, SensorUnavailable, SourceNotFound
from ..storage.errors import NewerFormat, StorageError
from .commands import emulator, results, service, settings, sources, storage
from .config import ConfigError
from .install import InstallError
from .notify import log_handler

# sysexits.h; systemd prints these names. 2 is click's own code for a wrong use of a command.
EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (SourceNotFound, 66),
    (BadCapture, 65),
    (BadMetadata, 65),
    (SensorUnavailable, 69),
    (DriverError, 65),
    (ConfigError, 78),
    (InstallError, 69),
    (NewerFormat, 78),
    (StorageError, 74),
    (OSError, 74),
)


class _Group(click.Group):
    """Turns the libraries' errors into one line on stderr and an exit code."""

    def invoke(self, ctx: click.Context):
        try:
            return super().invoke(ctx)
        except (click.exceptions.Exit, click.Abort, click.ClickException, BrokenPipeError):
            raise
        except Exception as error:
            code = next((code for kind, code in _exit_codes() if isinstance(error, kind)), None)
            if code is None:
                raise
            click.echo(f"Error: {error}", err=True)
            ctx.exit(code)


def _exit_codes():
    from ..models.descriptor import ModelError  # onnxruntime: not for every command

    return ((ModelError, 78), *EXIT_CODES)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="revisitd")
@click.option("-v", "--verbose", count=True, help="Say more: -v what happens, -vv details.")
def cli(verbose: int) -> None:
    """Tells what has changed in a place since the robot's earlier visits, from an Ouster OS1's packets.

    Exit codes: 0 done, 1 fsck has found problems, 2 wrong use, 65 bad data (capture or metadata), 66 no such source,
    69 sensor not reached or systemd not there, 74 input/output (disk, data directory), 78 settings, model, or a data
    directory of a newer revisitd.
    """
    level = {0: logging.ERROR, 1: logging.INFO}.get(verbose, logging.DEBUG)
    logging.basicConfig(level=level, handlers=[log_handler()])


for command in (
    sources.demo,
    sources.replay,
    service.run,
    service.status,
    results.changes,
    results.place,
    results.trajectory,
    results.plot,
    sources.simulate,
    emulator.emulate,
    settings.dump_config_,
    settings.check_config,
    storage.fsck,
    service.doctor,
    service.install_service,
    service.uninstall_service,
):
    cli.add_command(command)


def main() -> None:
    """The program `revisitd`."""
    cli()
