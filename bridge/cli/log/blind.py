"""``gapbridge blind``."""

from __future__ import annotations

import importlib
import signal
import sys
from pathlib import Path

import click

from gapbridge.core.errors import RunError

CHECKOUT = Path(__file__).resolve().parents[3]
BENCHMARK = "benchmarks.blind.__main__"


# --help and every option are the benchmark's own
@click.command(
    context_settings={"ignore_unknown_options": True, "help_option_names": []},
    add_help_option=False,
)
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
@click.pass_context
def blind(context: click.Context, arguments: tuple[str, ...]) -> None:
    """Run the blind benchmark of the diagnosis.

    Data are drawn whose effect is withheld from the diagnosis, and its answers are scored. It
    needs a checkout of the project; the installed package has no benchmarks.

    Example: gapbridge blind --quick --out out/blind
    """
    try:
        command = benchmark()
    except RunError:
        if not {"-h", "--help"} & set(arguments):
            raise
        click.echo(context.get_help())
        return
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # else the pool of cases would finish first
    command.main(args=list(arguments), prog_name="gapbridge blind", standalone_mode=False)


def benchmark() -> click.Command:
    """Return the benchmark's command; raises RunError outside a checkout."""
    if (CHECKOUT / "benchmarks" / "blind").is_dir() and str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    try:
        command = importlib.import_module(BENCHMARK).main
    except ModuleNotFoundError as error:
        if error.name is None or not f"{BENCHMARK}.".startswith(f"{error.name}."):
            raise
        raise RunError(
            "blind: found no module benchmarks.blind, expected a checkout of the project: the "
            "benchmark is no part of the installed package"
        ) from None
    assert isinstance(command, click.Command)
    return command
