"""``gapbridge patch``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.schema import CauseEntry
from gapbridge.bridge.cli.options import FILE, cell_option, open_cell
from gapbridge.bridge.document.output_file import require_suffix, require_writable, write_text
from gapbridge.bridge.patch.model_format import PatchOptions, require_original
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.errors import InputError


@click.command()
@click.argument("model", type=FILE)
@cell_option
@click.option("--out", required=True, type=FILE, help="The patched model to write.")
@click.option(
    "--joints", metavar="A,B,...",
    help="The model's joints, in the order of the arm's; in a USD also prim paths.",
)  # fmt: skip
@click.option(
    "--tcp", metavar="NAME", help="The model's TCP: a site (MJCF), link (URDF) or Xform (USD)."
)
@click.option("--load", metavar="NAME", help="An MJCF's body that is the declared payload.")
@click.option(
    "--parameters",
    type=FILE,
    metavar="FILE",
    help="Write bounds for MuJoCo's sysid: .py (with modifiers) or .yaml.",
)
def patch(
    model: Path,
    cell: Path,
    out: Path,
    joints: str | None,
    tcp: str | None,
    load: str | None,
    parameters: Path | None,
) -> None:
    """Write a cell's effects into a simulator's model.

    MODEL is an MJCF (.xml), URDF or USD model of the cell's nominal arm. Geometry, offsets, tool,
    masses, friction, damping, armature, delay, lag, gain, flexibility and backlash are written if
    the format can represent them; the others are listed with the usual workaround. Effects that the
    diagnosis could not distinguish are written as a comment with both candidates. MODEL is not
    changed; for USD the output is a stronger layer.

    --parameters also writes bounds for MuJoCo's system identification: effects found by the
    diagnosis are free within three standard deviations, the others of the cell are fixed.

    Example: gapbridge patch ur10e.xml --cell better.yaml --out ur10e_real.xml --tcp attachment_site
    """
    from gapbridge.bridge.patch import changes_of, format_of

    kind = format_of(model)
    if not model.is_file():
        raise InputError(f"{model}: file not found, expected a model")
    if load and not kind.holds_load:
        raise InputError(f"--load: found with {model}, expected an MJCF (.xml)")
    opened = open_cell(cell)
    require_suffix(require_writable(out, model, cell), kind.text_suffixes)
    options = _options(opened, out, joints, tcp, load)
    require_original(model, options)
    bounds = None
    if parameters is not None:
        bounds = _bounds(model, opened, options, parameters, (out, cell))
    ties = tie_lines(opened.causes, opened.model.terms)
    patched = kind.patch(model, changes_of(opened.model), options, [f"cell: {cell.name}", *ties])
    write_text(out, patched.text)
    for line in patched.changed:
        click.echo(line)
    if not patched.changed:
        click.echo("nothing changed: the cell has no effect that this format holds")
    for line in patched.unsupported:
        click.echo(f"not held: {line}")
    for line in ties:
        click.echo(line)
    click.echo(f"{out}: written")
    if parameters is not None and bounds is not None:
        write_text(parameters, bounds)
        click.echo(f"{parameters}: written")


def _options(
    cell: Cell, out: Path, joints: str | None, tcp: str | None, load: str | None
) -> PatchOptions:
    names = tuple(name.strip() for name in joints.split(",")) if joints else ()
    origin = cell.file.provenance
    on_top = origin is not None and any(file.role == "sim" for file in origin.files)
    return PatchOptions(names, tcp or "", load or "", on_top, out.parent)


def _bounds(
    model: Path, cell: Cell, options: PatchOptions, file: Path, others: tuple[Path, ...]
) -> str:
    """Return the text of --parameters."""
    from gapbridge.bridge.patch.sysid import MODELS, SUFFIXES, parameters_text

    if model.suffix.lower() not in MODELS:
        raise InputError(f"--parameters: found the model {model}, expected an MJCF (.xml)")
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"--parameters {file}: found {suffix or 'no suffix'}, expected {' or '.join(SUFFIXES)}"
        )
    require_writable(file, model, *others)
    return parameters_text(model, cell, options, suffix)


def tie_lines(causes: Sequence[CauseEntry], terms: Sequence[Term]) -> tuple[str, ...]:
    """Return one line for each cause in the model that has ties: all candidates.

    The named cause is in the model with its value; for the others the line says how they are
    modelled and how to estimate their value.
    """
    in_model = {(term.effect, term.site.joint) for term in terms if not term.stand_in}
    lines = []
    for cause in causes:
        joints: list[int | None] = [*cause.joints] or [None]
        applied = any((cause.effect, joint) in in_model for joint in joints)
        if not (cause.indistinguishable_from and applied):
            continue
        numbers = ", ".join(
            f"{p.name} = {p.value:.6g} {p.unit}".rstrip()
            for p in cause.parameters
            if isinstance(p.value, float)
        )
        others = " or ".join(
            f"{name} ({CATALOGUE[name].simulator_advice})"
            if name in CATALOGUE and CATALOGUE[name].simulator_advice
            else name
            for name in cause.indistinguishable_from
        )
        lines.append(
            f"tie: either {numbers}, which is written, or {others}: the data do not separate them; "
            f"the other's value: diagnose with --withhold {cause.effect}"
        )
    return tuple(lines)
