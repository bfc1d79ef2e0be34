"""``gapbridge demo``."""

from __future__ import annotations

from pathlib import Path

import click

from gapbridge.bridge.cli.options import FILE
from gapbridge.bridge.document.output_file import require_folder


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
    type=FILE,
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
    """Calibrate, compensate and diagnose a simulated cell; no hardware needed.

    Connects over the real protocol to a simulated controller whose true flexibilities are drawn
    from the seed and hidden, measures poses, fits, compensates, diagnoses, and writes a report: a
    UR10e over RTDE, a compliant AgileX PiPER on CAN, or a UR10e that is moved by its own program,
    over Modbus. The arm also has a bent tool (over RTDE, with some seeds, a joint whose zero is off
    instead), which the fit of flexibilities does not model: the diagnosis must identify it, and the
    test poses are measured again with it in the model. The demo fails if the diagnosis names a
    cause that the simulated arm does not have.

    Example: gapbridge demo --seed 3

    Example: gapbridge demo --link can --out out/demo_can
    """
    require_folder(out, "--out")
    from gapbridge.bridge.demo import run_demo  # imports the simulated controllers

    run_demo(seed=seed, out=out, link=link)
