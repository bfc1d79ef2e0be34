"""``gapbridge init``."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from pydantic import ValidationError

from gapbridge import drivers
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.document import parse
from gapbridge.bridge.cell.first_cell import InitOptions, first_cell_text
from gapbridge.bridge.cell.live import read_valid_state
from gapbridge.bridge.cell.message import validation_errors
from gapbridge.bridge.cell.schema import CellFile
from gapbridge.bridge.cell.sections import LinkSettings
from gapbridge.bridge.cli.options import FILE
from gapbridge.bridge.document.output_file import require_cell, write_text
from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.errors import GapbridgeError, Implausible, InputError, InvalidStateError
from gapbridge.core.model import Model
from gapbridge.core.urdf import arm_from_urdf
from gapbridge.drivers import make_driver
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.controller_facts import ControllerFacts
from gapbridge.drivers.ur_rtde.enquiry import enquire

CAN_INTERFACE = re.compile(r"[a-z]*can[0-9]+")  # Linux names: can0, vcan0, slcan1


class ArmOptions(NamedTuple):
    """The arm, if its controller does not report which it is."""

    model: str | None
    urdf: Path | None
    tip: str | None


@click.command()
@click.argument("host")
@click.option("--out", required=True, type=FILE, metavar="CELL", help="The new cell.")
@click.option(
    "--driver",
    type=click.Choice(["ur_rtde", "modbus", "can", "canopen"]),
    default="ur_rtde",
    show_default=True,
    help="How the controller is reached. HOST of can and canopen: the interface (can0), the serial "
    "port of an slcan adapter, or the address of a socketcand server; of modbus: address or port.",
)
@click.option(
    "--profile", help="modbus, can, canopen: the profile of the controller (docs/porting.md)."
)
@click.option("--port", type=click.IntRange(1, 65535), help="modbus, socketcand: its port.")
@click.option("--model", help="A built-in arm, if the controller does not report which it moves.")
@click.option("--urdf", type=FILE, help="The arm's URDF, instead of --model.")
@click.option("--tip", help="The URDF's link that is the flange, if it has several ends.")
@click.option(
    "--link",
    "keys",
    multiple=True,
    metavar="KEY=VALUE",
    help="A further key of the cell's link, as gear=[50,50,50,20,20,20] or bitrate=500000.",
)
def init(
    host: str, out: Path, driver: str, profile: str | None, port: int | None,
    keys: tuple[str, ...], **arm: Any,
) -> None:  # fmt: skip
    """Write a cell file from what a controller reports; never moves the arm.

    A UR controller reports its model, factory calibration, TCP, payload, joint limits and rate
    (RTDE and the primary interface); others what their profile reads. Values that are not reported
    are left in the cell with a comment that asks for them.

    Example: gapbridge init 192.168.0.10 --out cell.yaml
    """
    require_cell(out)
    if out.exists():
        raise InputError(f"{out}: found a file that is already there, expected a new one")
    arm_options = ArmOptions(**arm)
    if arm_options.model is not None and arm_options.urdf is not None:
        raise InputError("--model: found beside --urdf, expected one of them")
    if arm_options.tip is not None and arm_options.urdf is None:
        raise InputError("--tip: found without --urdf, expected the URDF whose link it is")
    link = _link(host, driver, profile, port)
    for key, value in _link_keys(keys).items():
        if key in link:
            raise InputError(f"--link: found {key}, expected it once: HOST and options give it")
        link[key] = value
    settings = _settings(link)
    located = settings.located(Path.cwd())
    given = _given_arm(arm_options)  # before the controller is reached
    facts = (
        enquire(host, SYSTEM) if driver == "ur_rtde" else _read_facts(located, given, arm_options)
    )
    link |= {str(keys[-1]): _path_from_cell(path, out) for keys, path in settings.paths()}
    urdf = None if arm_options.urdf is None else _path_from_cell(arm_options.urdf, out)
    options = InitOptions(link, arm_options.model, urdf, arm_options.tip)
    text = first_cell_text(facts, options)
    _require_loadable(text, out)
    write_text(out, text)
    click.echo(f"{out}: written, {_facts_text(facts)}")
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
    if driver == "ur_rtde":
        if port is not None:
            raise InputError("--port: found with --driver ur_rtde, expected none: it is 30004")
        if profile is not None:
            raise InputError("--profile: found with --driver ur_rtde, expected none")
        return {"driver": driver, "host": host}
    link: dict[str, Any] = {"driver": driver, "profile": profile}
    if driver == "modbus":
        link |= {"transport": "rtu", "serial": host} if "/" in host else {"host": host}
    elif "/" in host:
        link |= {"interface": "slcan", "channel": host}
    elif CAN_INTERFACE.fullmatch(host):
        link |= {"interface": "socketcan", "channel": host}
    else:
        link |= {"interface": "socketcand", "host": host}
    return link if port is None else {**link, "port": port}


def _link_keys(keys: Sequence[str]) -> dict[str, Any]:
    """Return the keys of --link; values are YAML. Raises InputError."""
    for key in keys:
        if not re.match(r"\w+=.", key):
            raise InputError(f"--link: found {key!r}, expected KEY=VALUE")
    if not keys:
        return {}
    return parse("\n".join(key.replace("=", ": ", 1) for key in keys), Path("--link")).data


def _settings(link: dict[str, Any]) -> LinkSettings:
    """Return the settings of a link. Raises InputError."""
    try:
        settings = CellFile.model_validate({"robot": {"model": "ur10e"}, "link": link}).link
    except ValidationError as error:
        raise InputError(validation_errors(CellFile, error)[0][1]) from None
    assert settings is not None
    return settings


def _given_arm(arm_options: ArmOptions) -> Arm | None:
    """Return the arm of the options, None without one. Raises ArmError."""
    model, urdf, tip = arm_options
    if urdf is not None:
        return arm_from_urdf(urdf, tip)
    return None if model is None else builtin_arm(model)


def _read_facts(link: LinkSettings, arm: Arm | None, arm_options: ArmOptions) -> ControllerFacts:
    """Return what the controller reports by its profile; the arm's joints must be known."""
    if arm is None:
        raise InputError(
            f"--model: found nothing with --driver {link.driver}, expected --model or --urdf "
            "FILE: its controller does not report which arm it moves"
        )
    with make_driver(link, Model(arm=arm), clock=SYSTEM) as driver:
        try:
            return driver.facts(read_valid_state(driver))
        except InvalidStateError as error:
            if error.reason is not Implausible.VALUE:
                raise
            named = arm_options.urdf or f"--model {arm_options.model}"
            raise InputError(f"{named}: {error}{_link_keys_hint(link)}") from None


def _link_keys_hint(link: LinkSettings) -> str:
    """Return a hint on the settings that are wrong if joint angles exceed the arm's limits."""
    keys = [key for key in ("gear", "zero", "direction") if hasattr(link, key)]
    return f" (--link sets {', '.join(keys)})" if keys else " (the profile's unit and zero)"


def _path_from_cell(path: Path, out: Path) -> str:
    """Return a path relative to the cell's folder, or absolute if it is outside."""
    try:
        return str(path.resolve().relative_to(out.parent.resolve()))
    except ValueError:
        return str(path.resolve())


def _require_loadable(text: str, out: Path) -> None:
    """Raise GapbridgeError if the text is no valid cell: an invalid one is never written."""
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", dir=out.parent, encoding="utf-8") as file:
        file.write(text)
        file.flush()
        try:
            load_cell(file.name)
        except GapbridgeError as error:
            raise type(error)(str(error).replace(file.name, str(out))) from None


def _facts_text(facts: ControllerFacts) -> str:
    """Return text that lists what the controller has reported, and what not."""
    names = {
        "model": facts.model, "factory calibration": facts.calibration or None, "TCP": facts.tcp,
        "payload": facts.payload, "gravity": facts.gravity, "joint limits": facts.lower,
        "rate": facts.rate,
    }  # fmt: skip
    reported = [name for name, value in names.items() if value is not None]
    missing = [name for name, value in names.items() if value is None]
    joints = f"{facts.n} joints" if facts.q is None else f"{facts.n} joints at {_degrees(facts.q)}"
    return f"{joints}; reported: {', '.join(reported) or 'nothing else'}" + (
        f"; not reported: {', '.join(missing)}" if missing else ""
    )


def _degrees(q: np.ndarray[Any, Any]) -> str:
    return "[" + ", ".join(f"{np.degrees(v):.1f}" for v in q) + "] degrees"
