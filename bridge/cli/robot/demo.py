"""``gapbridge demo``."""

from __future__ import annotations

from pathlib import Path

import click

from gapbridge.bridge.cli.optional import member
from gapbridge.core.errors import InputError


@click.command()
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Seed of the hidden plant and of all noise.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("out/demo"),
    show_default=True,
    help="Folder for summary.json and report.html.",
)
@click.option(
    "--link",
    default="ur_rtde",
    show_default=True,
    help="Driver by which the simulated cell is reached: ur_rtde, can or modbus.",
)
def demo(seed: int, out: Path, link: str) -> None:  # fmt: skip
    """Do the whole job on a simulated cell, no hardware needed.

    Connect, measure, calibrate, compensate, diagnose, report: over the real protocol, against a
    simulated controller whose flexibilities are drawn from the seed and hidden. A UR10e over RTDE,
    a soft AgileX PiPER on CAN, or a UR10e whose own program moves it, over Modbus. The UR10e over
    RTDE has a bent tool too, which no fit of flexibilities knows: the diagnosis has to name it, it
    is applied, and the same poses are visited again. The demo fails where the diagnosis accuses
    anything that the simulated arm does not have.

    Example: gapbridge demo --seed 3
    Example: gapbridge demo --link can --out out/demo_can
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: found a file, expected a folder for --out")
    member("gapbridge.bridge.demo", "run_demo", "demo")(seed=seed, out=out, link=link)
