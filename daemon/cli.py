"""Commands. Data goes to stdout, what happens to stderr; each kind of error has its exit code."""

from __future__ import annotations

import contextlib
import logging
import sys
import threading
from pathlib import Path

import click

from .. import __version__
from ..drivers.errors import BadCapture, BadMetadata, DriverError, SensorUnavailable, SourceNotFound
from ..storage.errors import StorageError
from .config import ConfigError, dump_config, load_config

# sysexits.h; systemd prints these names. 2 is click's own code for a wrong use of a command.
EXIT_CODES: tuple[tuple[type[Exception], int], ...] = (
    (SourceNotFound, 66),
    (BadCapture, 65),
    (BadMetadata, 65),
    (SensorUnavailable, 69),
    (DriverError, 65),
    (ConfigError, 78),
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


DATA = click.option(
    "--data",
    type=click.Path(file_okay=False, path_type=Path),
    required=True,
    help="Data directory: scans, index and changes.",
)
CONFIG = click.option(
    "--config", "config_path", type=click.Path(path_type=Path), help="Settings (TOML); defaults without it."
)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="revisitd")
@click.option("-v", "--verbose", count=True, help="Say more: -v what happens, -vv details.")
def cli(verbose: int) -> None:
    """Tells what has changed in a place since the robot's earlier visits, from an Ouster OS1's packets.

    Exit codes: 0 done, 2 wrong use, 65 bad data (capture or metadata), 66 no such source, 69 sensor not
    reached, 74 input/output (disk, data directory), 78 settings or model.
    """
    level = {0: logging.ERROR, 1: logging.INFO}.get(verbose, logging.DEBUG)
    logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(name)s: %(message)s")


@cli.command()
@click.argument("source")
@DATA
@click.option("--meta", type=click.Path(path_type=Path), help="The sensor's metadata JSON, if not beside a capture.")
@click.option("--rate", default="max", show_default=True, help="'max' (nothing is dropped) or a multiple of real time.")
@CONFIG
def replay(source: str, data: Path, meta: Path | None, rate: str, config_path: Path | None) -> None:
    """Run SOURCE (a pcap, an OSF file, or a sensor's host name) through the whole program.

    The path is the robot's own: gate, odometry, key scans, scenes, change detection. At 'max' the result is the
    same each time.

    \b
    Examples:
      revisitd replay patrol.pcap --data out
      revisitd replay patrol.pcap --meta os1.json --data out --rate 1.0
    """
    from .progress import ReplayProgress, summary_text
    from .replay import replay as run

    config = load_config(config_path)
    with ReplayProgress(source) as progress:
        summary = run(source, data, meta, config, _rate(rate), progress)
    click.echo(summary_text(summary), err=True)


def _rate(text: str) -> float | None:
    if text == "max":
        return None
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < 1000:
        raise click.BadParameter(f"{text!r} is neither 'max' nor a number above 0", param_hint="--rate")
    return rate


SHARE = click.FloatRange(0, 1)
SECONDS = click.FloatRange(min=0)


@cli.command()
@click.argument("capture", type=click.Path(path_type=Path))
@click.option("--meta", type=click.Path(path_type=Path), help="The sensor's metadata JSON, if not beside the capture.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address here that the sensor has.")
@click.option("--http-port", default=8080, show_default=True, help="Where its HTTP answers; 0: any that is free.")
@click.option("--serial", type=int, help="Of the sensor; the capture's without it.")
@click.option("--loop", is_flag=True, help="Play it again and again; frame ids and times go on.")
@click.option("--rate", type=click.FloatRange(0.01, 100), default=1.0, show_default=True, help="Times real time.")
@click.option("--warmup", type=SECONDS, default=1.0, show_default=True, help="Seconds until a configuration holds.")
@click.option("--drop", type=SHARE, default=0.0, show_default=True, help="Share of packets that are not sent.")
@click.option("--corrupt", type=SHARE, default=0.0, show_default=True, help="Share of packets with a wrong byte.")
@click.option("--reboot-after", type=SECONDS, help="Seconds until it restarts: new init id, settings and clock.")
@click.option("--reboot-for", type=SECONDS, default=5.0, show_default=True, help="... and is away for so long.")
@click.option("--silence-after", type=SECONDS, help="Seconds until it sends nothing.")
@click.option("--silence-for", type=SECONDS, default=5.0, show_default=True, help="... for so long.")
@click.option("--step-after", type=SECONDS, help="Seconds until its clock jumps.")
@click.option("--step-by", type=float, default=37.0, show_default=True, help="... by so many seconds.")
@click.option("--seed", default=0, show_default=True, help="Of what happens at random.")
def emulate(
    capture: Path,
    meta: Path | None,
    host: str,
    http_port: int,
    serial: int | None,
    loop: bool,
    rate: float,
    warmup: float,
    drop: float,
    corrupt: float,
    reboot_after: float | None,
    reboot_for: float,
    silence_after: float | None,
    silence_for: float,
    step_after: float | None,
    step_by: float,
    seed: int,
) -> None:
    """Be the sensor that recorded CAPTURE (a pcap), with the faults asked for: HTTP here, UDP to whom asks.

    It ends with the capture, or at Ctrl-C. More faults, at any time: POST http://HOST:PORT/emulator/faults, a JSON
    object of drop, corrupt, silence_s, reboot_s, step_s, http ("error", "garbage", "slow", "none").

    \b
    Examples:
      revisitd emulate patrol.pcap --loop
      revisitd emulate patrol.pcap --reboot-after 30 --drop 0.01
    """
    from ..drivers.emulator import Emulator

    emulator = Emulator(capture, meta, host, http_port, loop, rate, serial, warmup, seed)
    click.echo(f"sensor at {emulator.address}")
    emulator.inject({"drop": drop, "corrupt": corrupt})
    timed = [
        (reboot_after, {"reboot_s": reboot_for}),
        (silence_after, {"silence_s": silence_for}),
        (step_after, {"step_s": step_by}),
    ]
    schedule = sorted((item for item in timed if item[0] is not None), key=lambda item: item[0])
    with contextlib.closing(emulator), contextlib.suppress(KeyboardInterrupt):
        emulator.run(threading.Event(), schedule)


@cli.command()
@DATA
@click.option("--format", "form", type=click.Choice(["table", "json", "csv"]), default="table", show_default=True,
              help="For people, or for programs.")  # fmt: skip
@click.option("--points", is_flag=True, help="Each change's points too (JSON).")
@click.option("--min-points", default=0, show_default=True, help="Only changes of at least so many points.")
def changes(data: Path, form: str, points: bool, min_points: int) -> None:
    """List the changes found. Metres, in the map frame: the sensor's pose at the end of the first accepted frame
    of the first session (x forward, y left, z up)."""
    from ..storage.store import Store
    from . import report

    with Store.open_reader(data) as store:
        found = store.changes.changes(min_points=min_points, with_points=points)
    if form == "table":
        click.echo(report.changes_table(found))
    elif form == "csv":
        click.echo(report.changes_csv(found), nl=False)
    else:
        click.echo(report.changes_json(found, with_points=points))


@cli.command(context_settings={"ignore_unknown_options": True})  # -3.5 is a coordinate
@click.argument("x", type=float)
@click.argument("y", type=float)
@click.argument("z", type=float)
@DATA
@CONFIG
@click.option("--radius", default=0.3, show_default=True, help="Of the place, metres.")
@click.option("--map", "map_id", type=int, help="Of which map; the newest without it.")
@click.option("--format", "form", type=click.Choice(["table", "json"]), default="table", show_default=True,
              help="For people, or for programs.")  # fmt: skip
def place(
    x: float, y: float, z: float, data: Path, config_path: Path | None, radius: float, map_id: int | None, form: str
) -> None:
    """Say what each visit saw at X Y Z (metres, map frame): the same as before, a change, or nothing."""
    import numpy as np

    from ..storage.store import Store
    from . import report
    from .places import place_history

    config = load_config(config_path)
    with Store.open_reader(data) as store:
        maps = [scene.map_id for scene in store.index.scenes()]
        map_id = map_id if map_id is not None else max(maps, default=0)
        history = place_history(store, map_id, np.array([x, y, z]), radius, config.detection)
    click.echo(report.place_json(history) if form == "json" else report.place_table(history))


@cli.command()
@DATA
@click.option("--session", type=int, help="Of one session only.")
def trajectory(data: Path, session: int | None) -> None:
    """Print the key scans' poses in the map frame, TUM format: t x y z qx qy qz qw (seconds, sensor clock)."""
    from ..storage.store import Store
    from . import report

    with Store.open_reader(data) as store:
        path = store.index.trajectory(session)
    click.echo(report.trajectory_tum(path.stamp_ns, path.T_map_sensor), nl=False)


@cli.command()
@DATA
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True, help="PNG to write.")
def plot(data: Path, output: Path) -> None:
    """Draw a map seen from above: trajectory, scenes, and changes by polarity."""
    from .plot import plot_map

    plot_map(data, output)
    click.echo(output)


@cli.command()
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.option("--scenario", default="short", show_default=True, help="See --list.")
@click.option("--seed", default=0, show_default=True, help="Another seed is another world and another patrol.")
@click.option("--beams", type=click.Choice(["32", "64", "128"]), default="128", show_default=True, help="Of the OS1.")
@click.option("--columns", type=click.Choice(["512", "1024", "2048"]), default="1024", show_default=True,
              help="Of a rotation.")  # fmt: skip
@click.option("--profile", default="RNG19_RFL8_SIG16_NIR16", show_default=True, help="Of the lidar packets.")
@click.option("--list", "list_", is_flag=True, is_eager=True, expose_value=False, callback=lambda *a: _list(*a),
              help="List the scenarios.")  # fmt: skip
def simulate(out: Path, scenario: str, seed: int, beams: str, columns: str, profile: str) -> None:
    """Write a virtual patrol as OS1 packets: OUT/*.pcap, its metadata, and the truth (needs the extra [sim])."""
    capture = _simulate(out, scenario, seed, int(beams), int(columns), profile)
    click.echo(f"{capture.pcap}\n{capture.metadata}\n{capture.truth}")


def _simulate(out: Path, scenario: str, seed: int, beams: int, columns: int, profile: str):
    virtual = _virtual()
    if scenario not in virtual.SCENARIOS:
        known = ", ".join(virtual.SCENARIOS)
        raise click.BadParameter(f"{scenario!r} is not known; known: {known}", param_hint="--scenario")
    with click.progressbar(length=1000, label=f"simulating {scenario}", file=sys.stderr) as bar:
        done = 0

        def progress(frame: int, n_frames: int) -> None:
            nonlocal done
            step = 1000 * frame // n_frames - done
            bar.update(step)
            done += step

        return virtual.simulate(
            out, scenario=scenario, seed=seed, beams=beams, columns=columns, profile=profile, progress=progress
        )


def _virtual():
    try:
        from ..drivers import virtual
    except ImportError as error:
        raise click.ClickException(f"the virtual sensor needs the extra [sim] ({error.name} is missing)") from error
    return virtual


def _list(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        for name, scenario in _virtual().SCENARIOS.items():
            click.echo(f"{name:10s} {scenario.about}")
        ctx.exit()


@cli.command()
@click.argument("out", type=click.Path(file_okay=False, path_type=Path), default=Path("demo"))
@click.option("--seed", default=0, show_default=True, help="Another seed is another world.")
@click.pass_context
def demo(ctx: click.Context, out: Path, seed: int) -> None:
    """See it work without a robot: a virtual patrol, its packets replayed, the changes found, a picture.

    Writes OUT/patrol (capture and truth), OUT/data (the store) and OUT/map.png.
    """
    from .demo import compare_with_truth, fresh

    fresh(out)
    capture = _simulate(out / "patrol", "demo", seed, 128, 1024, "RNG15_RFL8_NIR8")
    ctx.invoke(replay, source=str(capture.pcap), data=out / "data", meta=None, rate="max", config_path=None)
    click.echo()
    ctx.invoke(changes, data=out / "data", form="table", points=False, min_points=0)
    click.echo()
    click.echo(compare_with_truth(out / "data", capture.truth))
    ctx.invoke(plot, data=out / "data", output=out / "map.png")


@cli.command("check-config")
@click.argument("path", type=click.Path(path_type=Path))
def check_config(path: Path) -> None:
    """Check a settings file; exit code 78 and a line for each problem where it is wrong."""
    load_config(path)
    click.echo(f"{path}: ok")


@cli.command("dump-config")
@CONFIG
def dump_config_(config_path: Path | None) -> None:
    """Print all settings with units, defaults and reasons, as TOML."""
    click.echo(dump_config(load_config(config_path)), nl=False)


def main() -> None:
    """The program `revisitd`."""
    cli()
