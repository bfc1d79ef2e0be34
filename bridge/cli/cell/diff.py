"""``gapbridge diff``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.difference import (
    KeyChange,
    PartChange,
    TcpShift,
    key_changes,
    part_changes,
    random_poses,
    tcp_shift,
)
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cli.options import FILE, open_cell
from gapbridge.bridge.document.numbers import unit_of
from gapbridge.bridge.document.provenance import provenance
from gapbridge.bridge.report.labels import effect_title
from gapbridge.core.arm import Arm
from gapbridge.core.effects import Reported, Term, effect_named
from gapbridge.core.rotation import rotation_vector


@click.command()
@click.argument("before", type=FILE)
@click.argument("after", type=FILE)
@click.option("--log", type=FILE, help="Compare over its poses and loads instead.")
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the random poses.")
@click.option("--json", "as_json", is_flag=True, help="As JSON, SI units.")
def diff(before: Path, after: Path, log: Path | None, seed: int, as_json: bool) -> None:
    """List the differences of two cells, and how far each moves the TCP.

    The predicted TCP is compared over 200 random poses within the joint limits, with each cell's
    own payload, or over the poses and loads of a log: each difference alone, the largest first, and
    all together.

    Example: gapbridge diff cell.yaml calibrated.yaml
    """
    one, other = open_cell(before), open_cell(after)
    changes = key_changes(one, other)
    rows = None if log is None else open_log(log, one)
    q = random_poses(one, seed) if rows is None else rows.require("actual_q", "target_q")
    loads = None if rows is None else rows.loads()
    shift = tcp_shift(one, other, q, loads)
    parts = part_changes(one, other, q, loads)
    if as_json:
        reported = {
            "changes": [change.to_json() for change in changes],
            "parts": [_part_json(part, one, other) for part in parts],
            "moved": None if shift is None else shift.to_json(),
            "provenance": provenance({"cell": [before, after], "log": [log] if log else []}),
        }
        click.echo(json.dumps(reported, indent=1))
        return
    if not changes:
        click.echo("no key differs")
    for change in changes:
        if not (parts and change.in_model):
            click.echo(_change_line(change))
    for part in parts:
        click.echo(f"{_part_text(part, one, other)}{_part_shift_text(part.shift)}")
    _print_origin(other)
    click.echo(_total_shift_text(shift, "the log" if log else "the workspace"))


def _change_line(change: KeyChange) -> str:
    if change.before is None:
        return f"{change.key}: added, {_text(change.after)}"
    if change.after is None:
        return f"{change.key}: removed, was {_text(change.before)}"
    return f"{change.key}: {_text(change.before)} -> {_text(change.after)}"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_text(item) for item in value) + "]"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items() if item is not None)
    return str(value)


def _part_json(part: PartChange, one: Cell, other: Cell) -> dict[str, Any]:
    """Return a part as text, and how far it alone moves the predicted TCP, SI units."""
    shift = None if part.shift is None else part.shift.to_json()
    return {"part": part.name, "words": _part_text(part, one, other), "moved": shift}


def _part_shift_text(shift: TcpShift | None) -> str:
    if shift is None:
        return ""
    return f"; alone {1e3 * shift.rms:.3f} mm rms at the TCP, at most {1e3 * shift.largest:.3f} mm"


def _part_text(part: PartChange, one: Cell, other: Cell) -> str:
    """Return what differs in a part: lengths in mm, angles in mrad, compliance in µrad/Nm."""
    old, new = one.model, other.model
    if part.name == "tool":
        offset = np.asarray(np.linalg.solve(old.tool_in_flange, new.tool_in_flange), dtype=float)
        turned = 1e3 * float(np.linalg.norm(rotation_vector(offset[:3, :3])))
        return (
            f"TCP: {_mm(old.tool_in_flange[:3, 3])} -> {_mm(new.tool_in_flange[:3, 3])} in the "
            f"flange frame, {1e3 * np.linalg.norm(offset[:3, 3]):.3f} mm apart"
            + (f", turned by {turned:.3f} mrad" if turned > 1e-6 else "")
        )
    if part.name == "payload":
        return (
            f"payload: {old.payload_mass:g} kg at {_mm(old.payload_cog)} -> "
            f"{new.payload_mass:g} kg at {_mm(new.payload_cog)} in the flange frame"
        )
    if part.name == "gravity":
        before, after = (", ".join(f"{v:.4g}" for v in model.gravity) for model in (old, new))
        return f"gravity: ({before}) -> ({after}) m/s2 in base"
    if part.name == "reference_temperature":
        before, after = (f"{model.reference_temperature:g}" for model in (old, new))
        return f"reference temperature: {before} -> {after} °C"
    site = part.site
    where = "" if site is None or site.joint is None else f" of joint {site.joint}"
    where += "" if site is None or site.order is None else f", {site.order:g} a turn"
    return f"{effect_title(part.name)} ({part.name}){where}: {_values(part, one.arm, other.arm)}"


def _mm(vector: np.ndarray[Any, Any]) -> str:
    return "(" + ", ".join(f"{1e3 * v + 0.0:.6g}" for v in vector) + ") mm"


def _values(part: PartChange, one: Arm, other: Arm) -> str:
    """Return the parameters of an effect, before and after; zero in both is left out."""
    before, after = _reported(part.before, one), _reported(part.after, other)
    longest = max((*before, *after), key=len)  # of a term that ends before its optional parameter
    texts = []
    for k, number in enumerate(longest):
        unit, factor = unit_of(number.unit)
        name = number.part if len(longest) > 1 else ""
        sides = [
            [factor * term[k].value if k < len(term) else 0.0 for term in side]
            for side in (before, after)
            if side
        ]
        if any(map(any, sides)):
            shown = " -> ".join(" + ".join(f"{value:.4g}" for value in side) for side in sides)
            texts.append(f"{name} {shown} {unit}".strip())
    return f"{'' if before else 'added, '}{'' if after else 'removed, was '}{', '.join(texts)}"


def _reported(terms: Sequence[Term], arm: Arm) -> list[tuple[Reported, ...]]:
    return [effect_named(term.effect).reported(arm, term, None) for term in terms]


def _print_origin(cell: Cell) -> None:
    origin = cell.file.provenance
    if origin is not None and origin.command:
        logs = ", ".join(file.name for file in origin.files if file.role == "log")
        click.echo(
            f"{cell.path} was written by {origin.command}, {origin.time}, version {origin.version}"
            + (f", from {logs}" if logs else "")
        )


def _total_shift_text(shift: TcpShift | None, over: str) -> str:
    if shift is None:
        return "the predicted TCP cannot be compared: the arms have other joints, or no equilibrium"
    if shift.largest < 1e-9 and shift.turned < 1e-9:
        return f"over {shift.poses} poses of {over} the predicted TCP is the same"
    pose = ", ".join(f"{np.degrees(angle):.0f}" for angle in shift.where)
    mean = ", ".join(f"{1e3 * v:+.3f}" for v in shift.mean)
    return (
        f"over {shift.poses} poses of {over} the predicted TCP moves by {1e3 * shift.rms:.3f} mm "
        f"rms, at most {1e3 * shift.largest:.3f} mm (joints at {pose} degrees) and "
        f"{1e3 * shift.turned:.3f} mrad; on average by [{mean}] mm in base"
    )
