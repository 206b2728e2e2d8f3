"""Commands that read what was found: changes, place, trajectory, plot."""

from __future__ import annotations

from pathlib import Path

import click

from ..config import load_config
from .options import CONFIG, DATA


@click.command()
@DATA
@click.option("--format", "form", type=click.Choice(["table", "json", "csv"]), default="table", show_default=True,
              help="For people, or for programs.")  # fmt: skip
@click.option("--points", is_flag=True, help="Each change's points too (JSON).")
@click.option("--min-points", default=0, show_default=True, help="Only changes of at least so many points.")
@click.option("--follow", "follows", is_flag=True, help="Go on: a line of JSON for each new or altered change.")
@click.option("--since", type=int, help="Lines of JSON for what is new or altered after this revision.")
def changes(data: Path, form: str, points: bool, min_points: int, follows: bool, since: int | None) -> None:
    """List the changes found. Metres, in the map frame: the sensor's pose at the end of the first accepted frame
    of the first session (x forward, y left, z up).

    With --follow or --since: one JSON object a line, in the order of "revision". Each was "changed" (new, or altered,
    as it is now) or "merged" (it is a part of another, and no change any more). Who stops goes on with --since and
    the last revision read, and misses nothing.
    """
    from ...storage.store import Store
    from .. import report

    if follows or since is not None:
        _lines(data, points, follows, since or 0)
        return
    with Store.open_reader(data) as store:
        found = store.changes.changes(min_points=min_points, with_points=points)
    if form == "table":
        click.echo(report.changes_table(found))
    elif form == "csv":
        click.echo(report.changes_csv(found), nl=False)
    else:
        click.echo(report.changes_json(found, with_points=points))


def _lines(data: Path, points: bool, forever: bool, since: int) -> None:
    from ...storage.datadir import DataDir
    from ..follow import follow

    try:
        # click.echo flushes: a program at the other end of a pipe sees each line at once.
        follow(DataDir.open_reader(data).changes_path, since, points, click.echo, forever)
    except KeyboardInterrupt:
        pass


@click.command(context_settings={"ignore_unknown_options": True})  # -3.5 is a coordinate
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

    from ...storage.store import Store
    from .. import report
    from ..places import place_history

    config = load_config(config_path)
    with Store.open_reader(data) as store:
        maps = [scene.map_id for scene in store.index.scenes()]
        map_id = map_id if map_id is not None else max(maps, default=0)
        history = place_history(store, map_id, np.array([x, y, z]), radius, config.detection)
    click.echo(report.place_json(history) if form == "json" else report.place_table(history))


@click.command()
@DATA
@click.option("--session", type=int, help="Of one session only.")
def trajectory(data: Path, session: int | None) -> None:
    """Print the key scans' poses in the map frame, TUM format: t x y z qx qy qz qw (seconds, sensor clock)."""
    from ...storage.store import Store
    from .. import report

    with Store.open_reader(data) as store:
        path = store.index.trajectory(session)
    click.echo(report.trajectory_tum(path.stamp_ns, path.T_map_sensor), nl=False)


@click.command()
@DATA
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), required=True, help="PNG to write.")
def plot(data: Path, output: Path) -> None:
    """Draw a map seen from above: trajectory, scenes, and changes by polarity."""
    from ..plot import plot_map

    plot_map(data, output)
    click.echo(output)
