"""The command that looks after the data directory: fsck."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("data", type=click.Path(file_okay=False, path_type=Path))
@click.option("--repair", is_flag=True, help="Mend what can be mended; the daemon must not run.")
@click.pass_context
def fsck(ctx: click.Context, data: Path, repair: bool) -> None:
    """Compare what the parts of the data directory DATA say of each other; exit code 1 where something is wrong.

    Changes nothing without --repair, and then deletes nothing: what is damaged is moved aside. One line for each
    problem says what is wrong and what repairing does about it.
    """
    from ...storage import fsck as storage

    found = storage.check(data)
    for line in found.lines():
        click.echo(line)
    if repair and found.lines():
        repairs, found = storage.repair(data)
        for line in repairs:
            click.echo(f"repaired: {line}")
        for line in found.lines():
            click.echo(f"still wrong: {line}")
    counts = ", ".join(f"{count} {what}" for what, count in found.counts.items())
    click.echo(f"{data}: {counts}: {'clean' if not found.lines() else f'{len(found.lines())} problems'}")
    ctx.exit(1 if found.lines() else 0)
