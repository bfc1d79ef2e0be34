"""The entry point: lazily imported commands, one-line errors, three exit codes."""

from __future__ import annotations

import contextlib
import errno
import gc
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pkgutil import resolve_name
from types import FrameType
from typing import Any, NoReturn

import click

from gapbridge.bridge.cli.progress import CompileProgress
from gapbridge.bridge.cli.table import COMMANDS, ROBOT
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.kernels import compiling
from gapbridge.drivers.clock import SYSTEM

INTERRUPT_RETRY = 0.02  # s until an interrupt inside LLVM is tried again
SUCCESS, FAILURE, UNUSABLE_INPUT = 0, 1, 2
BY_SIGNAL = 128  # and its number, as a shell has it
UNUSABLE_PATH = (errno.EACCES, errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP)


class CommandTable(click.Group):
    """A group whose commands are imported on use, which keeps ``--help`` fast."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a command.

        Garbage collection is off meanwhile: it would take 0.2 s and free nothing.
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
        """Return the named command; an unknown name is reported with the most similar one."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            import difflib

            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(COMMANDS)}"
            raise click.UsageError(f"found an unknown command {args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, line) for name, (_, line) in COMMANDS.items()])


def _print_version(ctx: click.Context, _: click.Parameter, requested: bool) -> None:
    """Print the version and exit."""
    if not requested or ctx.resilient_parsing:
        return
    # imported here: a fifth of the time of --help
    from importlib.metadata import PackageNotFoundError, version

    try:
        installed = version("gapbridge")
    except PackageNotFoundError:
        installed = "not installed"
    click.echo(f"gapbridge, version {installed}")
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
    """Run the command line and exit with its code; never shows a traceback."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with _usable_streams(), _handled_signals(arguments):
        code = _run(arguments)
    gc.freeze()  # saves the final garbage collection, 0.1 s
    sys.exit(code)


@contextlib.contextmanager
def _usable_streams() -> Iterator[None]:
    """Let text for a closed stream go nowhere, and replace what stdout's encoding lacks."""
    with contextlib.ExitStack() as stack:
        for stream, redirect in (
            (sys.stdout, contextlib.redirect_stdout), (sys.stderr, contextlib.redirect_stderr),
        ):  # fmt: skip
            if stream is None:
                nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
                stack.enter_context(redirect(nowhere))
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="replace")
        yield


def _run(arguments: list[str]) -> int:
    compiling.listeners[:] = [CompileProgress(SYSTEM.monotonic)]
    try:
        result = gapbridge.main(args=arguments, prog_name="gapbridge", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as error:
        return error.exit_code
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return UNUSABLE_INPUT
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "gapbridge"
        return _fail(f"{error.format_message()} (see {command} --help)", UNUSABLE_INPUT)
    except click.ClickException as error:
        return _fail(error.format_message(), UNUSABLE_INPUT)
    except (KeyboardInterrupt, click.Abort) as error:
        cause = error.__cause__ or error  # click wraps it
        if isinstance(cause, Terminated):
            return _fail("terminated", BY_SIGNAL + cause.number)
        return _fail("interrupted", BY_SIGNAL + signal.SIGINT)
    except GapbridgeError as error:
        return _fail(str(error), error.exit_code)
    except OSError as error:
        if error.errno in UNUSABLE_PATH and error.filename is not None:
            return _fail(f"{error.filename}: {error.strerror}", UNUSABLE_INPUT)
        if not _is_of_stdout(error):
            return _crash(error)
        # flushing stdout at exit must not fail either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):  # its reader has left
            return FAILURE
        return _fail(f"stdout: cannot be written: {error.strerror}", FAILURE)
    except Exception as error:
        return _crash(error)
    return int(result) if isinstance(result, int) else SUCCESS


def _is_of_stdout(error: OSError) -> bool:
    """Return whether an error came from printing: then an empty line fails, too."""
    if isinstance(error, BrokenPipeError):
        return True
    try:
        click.echo()
    except OSError:
        return True
    return False


def _fail(text: str, code: int) -> int:
    with contextlib.suppress(OSError):  # a full disk
        sys.stderr.write(f"error: {' '.join(text.split())}\n")
    return code


def _crash(error: Exception) -> int:
    """Report an unexpected error in one line; its traceback is written to a file."""
    import tempfile  # a twentieth of the time of --help
    import traceback

    what = " ".join(str(error).split()) or "no message"
    details = "no folder for details can be written to"
    with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(
        "w", prefix="gapbridge-crash-", suffix=".txt", delete=False, encoding="utf-8",
        errors="backslashreplace",  # arguments may be any bytes
    ) as file:  # fmt: skip
        file.write(" ".join(sys.argv) + "\n\n")
        traceback.print_exception(error, file=file)
        file.flush()
        details = f"details: {file.name}"
    return _fail(f"{type(error).__name__}: {what} ({details})", FAILURE)


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP: ends a command as Ctrl-C does, so that it removes what is half written."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


@contextlib.contextmanager
def _handled_signals(arguments: list[str]) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP (a closed terminal) end the command, but never inside LLVM.

    LLVM calls Python back while it loads a function. An exception there is printed and lost, or the
    half-loaded code crashes the process, which leaves an incomplete file. Commands of a robot keep
    their own SIGTERM and SIGHUP. An ignored signal stays ignored.
    """
    command = COMMANDS.get(arguments[0]) if arguments else None
    handled: dict[int, Any] = {signal.SIGINT: signal.default_int_handler}
    if command is None or not command[0].startswith(ROBOT):
        handled |= {signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    if threading.current_thread() is not threading.main_thread():
        handled = {}
    handled = {n: default for n, default in handled.items() if signal.getsignal(n) is default}
    for number in handled:
        signal.signal(number, _interrupted)
    try:
        yield
    finally:
        for number, default in handled.items():
            signal.signal(number, default)


def _interrupted(number: int, frame: FrameType | None) -> None:
    if not _in_llvm(frame):
        raise KeyboardInterrupt if number == signal.SIGINT else Terminated(number)
    retry = threading.Timer(INTERRUPT_RETRY, os.kill, (os.getpid(), number))
    retry.daemon = True
    retry.start()


def _in_llvm(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).startswith("llvmlite."):
            return True
        frame = frame.f_back
    return False
