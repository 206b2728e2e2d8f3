"""What a person sees of a replay: a progress line while it runs, a summary after."""

from __future__ import annotations

import sys
import time

import click

from .pipeline import Counts
from .replay import Summary

EVERY_S = 0.2


class ReplayProgress:
    """A progress bar with frames, speed, scenes and changes; a plain last line where stderr is no terminal."""

    def __init__(self, source: str):
        self._label = f"replaying {source.rsplit('/', 1)[-1]}"
        self._start = self._last = time.monotonic()
        self._tty = sys.stderr.isatty()

    def __enter__(self) -> ReplayProgress:
        return self

    def __exit__(self, *exc_info: object) -> None:
        if self._tty:
            click.echo(err=True)

    def __call__(self, counts: Counts, n_changes: int, n_frames: int | None) -> None:
        """Show the state, a few times a second."""
        now = time.monotonic()
        if not self._tty or now - self._last < EVERY_S:
            return
        self._last = now
        of = f"/{n_frames}" if n_frames else ""
        bar = ""
        if n_frames:
            filled = min(20, 20 * counts.frames // n_frames)
            bar = f"[{'#' * filled}{'-' * (20 - filled)}] "
        speed = counts.frames / (now - self._start)
        line = (
            f"{self._label} {bar}{counts.frames}{of} frames  {speed:.1f} frames/s  "
            f"{counts.scenes} scenes  {n_changes} changes"
        )
        click.echo(f"\r{line}\x1b[K", nl=False, err=True)


def summary_text(summary: Summary) -> str:
    """Two lines of what a run did, and one for each thing that went wrong, if it did."""
    c = summary.counts
    lines = [
        f"{c.frames} frames in {summary.seconds:.1f} s ({c.frames / summary.seconds:.1f} frames/s), "
        f"{c.key_scans} key scans, {c.scenes} scenes",
        f"{summary.instances_done} instances of change detection, {summary.instances_dropped} dropped, "
        f"{summary.instances_failed} failed; {summary.changes} changes",
    ]
    if c.not_stored:
        lines.append(f"{c.not_stored} key scans not stored: the disk or the index did not take them")
    if c.odometry_lost:
        lines.append(f"odometry lost {c.odometry_lost} times: each began a new session")
    if c.joined_maps:
        lines.append("joined to earlier maps: " + ", ".join(f"map {map_id}" for map_id in c.joined_maps))
    elif c.join_attempts:
        lines.append(f"not joined to an earlier map ({c.join_attempts} attempts): this run made a map of its own")
    if summary.losses:
        lines.append("lost: " + ", ".join(f"{count} x {cause}" for cause, count in summary.losses.items()))
    return "\n".join(lines)
