"""``gapbridge init``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import click
import numpy as np
from pydantic import ValidationError

from gapbridge import drivers
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.first_cell import Asked, first_cell
from gapbridge.bridge.cell.live import whole_state
from gapbridge.bridge.cell.sections import link_settings
from gapbridge.bridge.cli.options import FILE
from gapbridge.bridge.document.output_file import require_writable, write_text
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import GapbridgeError, InputError
from gapbridge.core.model import Model
from gapbridge.core.urdf import arm_from_urdf
from gapbridge.drivers import make_driver
from gapbridge.drivers.controller_facts import ControllerFacts
from gapbridge.drivers.ur_rtde.enquiry import enquire


@click.command()
@click.argument("host")
@click.option("--out", required=True, type=FILE, metavar="CELL", help="The new cell.")
@click.option(
    "--driver",
    type=click.Choice(["ur_rtde", "modbus", "can", "canopen"]),
    default="ur_rtde",
    show_default=True,
    help="How the controller is reached; for can and canopen HOST is the channel (can0), or the "
    "address of a socketcand server.",
)
@click.option(
    "--profile", help="modbus, can, canopen: the profile of the controller (docs/porting.md)."
)
@click.option("--port", type=click.IntRange(1, 65535), help="modbus, socketcand: its port.")
@click.option("--model", help="A built-in arm, where the controller does not say which it moves.")
@click.option("--urdf", type=FILE, help="The arm's URDF, instead of --model.")
def init(
    host: str, out: Path, driver: str, profile: str | None, port: int | None,
    model: str | None, urdf: Path | None,
) -> None:  # fmt: skip
    """Write a cell file from what a controller reports; never moves the arm.

    A UR controller reports its model, factory calibration, TCP, payload, joint limits and rate
    (RTDE and the primary interface); others what their profile reads. Values that are not reported
    are left in the cell with a comment that asks for them.

    Example: gapbridge init 192.168.0.10 --out cell.yaml
    """
    require_writable(out)
    if out.exists():
        raise InputError(f"{out}: found a file that is already there, expected a new one")
    if model is not None and urdf is not None:
        raise InputError("--model: found beside --urdf, expected one of them")
    link = _link(host, driver, profile, port)
    facts = enquire(host) if driver == "ur_rtde" else _read(link, model, urdf)
    text = first_cell(facts, Asked(link, model, None if urdf is None else _beside(urdf, out)))
    _check(text, out)
    write_text(out, text)
    click.echo(f"{out}: written, {_known_text(facts)}")
    click.echo(f"next: gapbridge check {out} --live; gapbridge run {out} --observe")


def _link(host: str, driver: str, profile: str | None, port: int | None) -> dict[str, Any]:
    """Return the keys of section ``link``. Raises InputError."""
    if driver != "ur_rtde" and profile is None:
        folder = Path(drivers.__file__).parent / driver / "profiles"
        known = ", ".join(sorted(path.stem for path in folder.glob("*.yaml")))
        raise InputError(
            f"--profile: found nothing with --driver {driver}, expected its map: one of {known}, "
            "or a file (docs/porting.md)"
        )
    link: dict[str, Any] = {"driver": driver}
    if profile is not None and driver != "ur_rtde":
        link["profile"] = profile
    if driver in ("can", "canopen"):
        served = "." in host
        link |= (
            {"interface": "socketcand", "host": host} if served
            else {"interface": "socketcan", "channel": host}
        )  # fmt: skip
    else:
        link["host"] = host
    if port is not None:
        if driver == "ur_rtde":
            raise InputError("--port: found with --driver ur_rtde, expected none: it is 30004")
        link["port"] = port
    try:
        link_settings(**link)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][-1]) if first["loc"] else "link"
        raise InputError(f"link.{key}: found {first['input']!r}: {first['msg']}") from None
    return link


def _read(link: dict[str, Any], model: str | None, urdf: Path | None) -> ControllerFacts:
    """Return what a profile reads of an arm; needs the arm's joints to know which there are."""
    if urdf is None and model is None:
        raise InputError(
            f"--model: found nothing with --driver {link['driver']}, expected --model or --urdf "
            "FILE: its controller does not say which arm it moves"
        )
    arm = arm_from_urdf(urdf) if urdf is not None else builtin_arm(str(model))
    settings = link_settings(**link).located(Path.cwd())
    with make_driver(settings, Model(arm=arm)) as driver:
        return driver.facts(whole_state(driver))


def _beside(urdf: Path, out: Path) -> str:
    """Return the URDF's path as the cell's folder sees it."""
    try:
        return str(urdf.resolve().relative_to(out.parent.resolve()))
    except ValueError:
        return str(urdf.resolve())


def _check(text: str, out: Path) -> None:
    """Raise where the cell cannot be loaded: nothing that no command reads is written."""
    with tempfile.NamedTemporaryFile(
        "w", suffix=".yaml", dir=out.parent, encoding="utf-8"
    ) as trial:
        trial.write(text)
        trial.flush()
        try:
            load_cell(trial.name)
        except GapbridgeError as error:
            raise type(error)(str(error).replace(trial.name, str(out))) from None


def _known_text(facts: ControllerFacts) -> str:
    """Return in words what the controller has said."""
    names = {
        "model": facts.model, "factory calibration": facts.calibration or None, "TCP": facts.tcp,
        "payload": facts.payload, "gravity": facts.gravity, "joint limits": facts.lower,
        "rate": facts.rate,
    }  # fmt: skip
    known = [name for name, value in names.items() if value is not None]
    missing = [name for name, value in names.items() if value is None]
    joints = f"{facts.n} joints" if facts.q is None else f"{facts.n} joints at {_degrees(facts.q)}"
    return f"{joints}; said: {', '.join(known) or 'nothing else'}" + (
        f"; not said: {', '.join(missing)}" if missing else ""
    )


def _degrees(q: np.ndarray[Any, Any]) -> str:
    return "[" + ", ".join(f"{np.degrees(v):.1f}" for v in q) + "] degrees"
