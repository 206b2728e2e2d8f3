"""Commands that run recordings and virtual patrols: replay, simulate, demo."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from ..config import load_config
from .options import CONFIG, DATA
from .results import changes, plot


@click.command()
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
    from ..progress import ReplayProgress, summary_text
    from ..replay import replay as run

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


@click.command()
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
        from ...drivers import virtual
    except ImportError as error:
        raise click.ClickException(f"the virtual sensor needs the extra [sim] ({error.name} is missing)") from error
    return virtual


def _list(ctx: click.Context, _param: click.Parameter, wanted: bool) -> None:
    if wanted and not ctx.resilient_parsing:
        for name, scenario in _virtual().SCENARIOS.items():
            click.echo(f"{name:10s} {scenario.about}")
        ctx.exit()


@click.command()
@click.argument("out", type=click.Path(file_okay=False, path_type=Path), default=Path("demo"))
@click.option("--seed", default=0, show_default=True, help="Another seed is another world.")
@click.pass_context
def demo(ctx: click.Context, out: Path, seed: int) -> None:
    """See it work without a robot: a virtual patrol, its packets replayed, the changes found, a picture.

    Writes OUT/patrol (capture and truth), OUT/data (the store) and OUT/map.png.
    """
    from ..demo import compare_with_truth, fresh

    fresh(out)
    capture = _simulate(out / "patrol", "demo", seed, 128, 1024, "RNG15_RFL8_NIR8")
    ctx.invoke(replay, source=str(capture.pcap), data=out / "data", meta=None, rate="max", config_path=None)
    click.echo()
    ctx.invoke(changes, data=out / "data", form="table", points=False, min_points=0)
    click.echo()
    click.echo(compare_with_truth(out / "data", capture.truth))
    ctx.invoke(plot, data=out / "data", output=out / "map.png")
