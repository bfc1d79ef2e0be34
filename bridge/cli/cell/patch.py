"""``gapbridge patch``."""

from __future__ import annotations

from pathlib import Path

import click

from gapbridge.bridge.cli.options import cell_option, open_cell
from gapbridge.bridge.document.output_file import require_writable, write_text
from gapbridge.core.errors import InputError


@click.command()
@click.argument("model", type=click.Path(path_type=Path))
@cell_option
@click.option(
    "--out", required=True, type=click.Path(path_type=Path), help="The patched model to write."
)
@click.option("--joints", metavar="A,B,...", help="The model's joints, in the order of the arm's.")
@click.option("--tcp", metavar="NAME", help="The model's TCP: a site (MJCF) or a link (URDF).")
def patch(model: Path, cell: Path, out: Path, joints: str | None, tcp: str | None) -> None:
    """Write a cell's effects into a simulator's model.

    MODEL is an MJCF (.xml) or a URDF model of the cell's nominal arm. Geometry, offsets,
    tool, masses, friction, damping, armature, delay, lag, gain, flexibility and play go where the
    format holds them; what it cannot hold is listed with what people do instead. MODEL itself stays
    as it is.

    Example: gapbridge patch ur10e.xml --cell better.yaml --out ur10e_real.xml --tcp attachment_site
    """
    from gapbridge.bridge.patch import PatchOptions, changes_of, format_of

    kind = format_of(model)
    if not model.is_file():
        raise InputError(f"{model}: file not found, expected a model")
    given = open_cell(cell)
    require_writable(out, model, cell)
    names = tuple(name.strip() for name in joints.split(",")) if joints else ()
    origin = given.file.provenance
    on_top = origin is not None and any(file.role == "sim" for file in origin.files)
    patched = kind.patch(
        model, changes_of(given.model), PatchOptions(names, tcp or "", on_top),
        [f"cell: {cell.name}"],
    )  # fmt: skip
    write_text(out, patched.text)
    for line in patched.changed:
        click.echo(line)
    if not patched.changed:
        click.echo("nothing changed: the cell has no effect that this format holds")
    for line in patched.not_held:
        click.echo(f"not held: {line}")
    click.echo(f"{out}: written")
