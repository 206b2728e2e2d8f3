"""The command that stands in for a sensor: emulate."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path

import click

SHARE = click.FloatRange(0, 1)
SECONDS = click.FloatRange(min=0)


@click.command()
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
    from ...drivers.emulator import Emulator

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
