"""The entry point: commands loaded on use, one line for every failure, three exit codes."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from pkgutil import resolve_name
from types import FrameType
from typing import NoReturn

import click

from gapbridge.bridge.cli.progress import Compiling
from gapbridge.bridge.cli.table import COMMANDS
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.kernels import compiling

WAIT = 0.02  # s until it is looked at again
SUCCESS, FAILURE, UNUSABLE = 0, 1, 2


class CommandTable(click.Group):
    """A group whose commands are imported when they are called, so that help is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, imported now.

        Nothing of an import is garbage: looking through it again and again costs 0.2 s.
        """
        if cmd_name not in COMMANDS:
            return None
        collecting = gc.isenabled()
        gc.disable()
        try:
            command = resolve_name(COMMANDS[cmd_name][0])
        finally:
            gc.freeze()
            if collecting:
                gc.enable()
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that is meant; an unknown one is reported with the nearest known."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(COMMANDS)}"
            raise click.UsageError(f"found an unknown command {args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the table, without importing any command."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


def _print_version(ctx: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Print the version and leave."""
    if not wanted or ctx.resilient_parsing:
        return
    # a fifth of what --help takes, and only needed here
    from importlib.metadata import PackageNotFoundError, version

    try:
        found = version("gapbridge")
    except PackageNotFoundError:
        found = "not installed"
    click.echo(f"gapbridge, version {found}")
    ctx.exit()


@click.group(cls=CommandTable, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the version and exit.",
)
def gapbridge() -> None:
    """Predict how an arm bends, correct its setpoints, find out why it misses.

    Exits 0 on success, 2 on unusable input, 1 on a failure at run time.

    Example: gapbridge demo
    """


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit code; never shows a traceback."""
    heed_interrupts()
    code = _run(sys.argv[1:] if arguments is None else arguments)
    gc.freeze()  # else Python's last collection, of all compiled code, costs 0.1 s
    sys.exit(code)


def _run(arguments: list[str]) -> int:
    compiling.listeners[:] = [Compiling()]
    try:
        result = gapbridge.main(args=arguments, prog_name="gapbridge", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as leaving:
        return leaving.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return UNUSABLE
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "gapbridge"
        return _fail(f"{error.format_message()} (see {command} --help)", UNUSABLE)
    except click.ClickException as error:
        return _fail(error.format_message(), UNUSABLE)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted", FAILURE)
    except GapbridgeError as error:
        return _fail(str(error), error.exit_code)
    except BrokenPipeError:
        # whoever read our output has left; a closed stdout must not complain at exit either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE
    except Exception as error:
        return _crash(error)
    return int(result) if isinstance(result, int) else SUCCESS


def _fail(text: str, code: int) -> int:
    sys.stderr.write(f"error: {' '.join(text.split())}\n")
    return code


def _crash(error: Exception) -> int:
    """Report an unforeseen failure in one line; its traceback goes to a file."""
    import tempfile  # a twentieth of what --help takes
    import traceback

    with tempfile.NamedTemporaryFile(
        "w", prefix="gapbridge-crash-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        file.write(" ".join(sys.argv) + "\n\n")
        traceback.print_exception(error, file=file)
    what = " ".join(str(error).split()) or "no message"
    return _fail(f"{type(error).__name__}: {what} (details: {file.name})", FAILURE)


def heed_interrupts() -> None:
    """Have Ctrl-C end the command, but never inside LLVM; where it is ignored it stays so.

    LLVM calls Python back while it loads a function. An interrupt there is shown as a traceback and
    lost, or what was half loaded crashes the process, which leaves half a file behind.
    """
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _interrupted)


def _interrupted(number: int, frame: FrameType | None) -> None:
    if not _in_llvm(frame):
        raise KeyboardInterrupt
    again = threading.Timer(WAIT, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _in_llvm(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).startswith("llvmlite."):
            return True
        frame = frame.f_back
    return False
