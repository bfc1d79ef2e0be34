"""``gapbridge run``, ``demo`` and ``blind``: the options that they pass on."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from cli_runs import Answer, cell_in, gapbridge, refused

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cli.log.blind import benchmark
from gapbridge.bridge.document.output_file import replacing
from gapbridge.core.errors import LinkError


def daemon(monkeypatch: pytest.MonkeyPatch, run_cell: object) -> None:
    module = ModuleType("gapbridge.bridge.daemon.run")
    module.run_cell = run_cell  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gapbridge.bridge.daemon.run", module)


def test_run_hands_the_cell_and_its_options_to_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Cell, dict[str, object]]] = []
    daemon(monkeypatch, lambda cell, **options: seen.append((cell, options)))
    path = cell_in(tmp_path)
    assert gapbridge("run", path, "--observe", "--duration", "1.5").code == 0
    ((cell, options),) = seen
    assert cell.path == path
    assert options == {"observe": True, "arm": False, "duration": 1.5, "log": None}


def test_a_broken_link_is_one_line_and_a_failure_at_run_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_cell(cell: Cell, **_: object) -> int:
        raise LinkError("127.0.0.2: cannot be reached")

    daemon(monkeypatch, run_cell)
    answer = gapbridge("run", cell_in(tmp_path))
    assert (answer.code, answer.err) == (1, "error: 127.0.0.2: cannot be reached\n")


def test_an_interrupt_ends_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_cell(cell: Cell, **_: object) -> int:
        raise KeyboardInterrupt

    daemon(monkeypatch, run_cell)
    answer = gapbridge("run", cell_in(tmp_path))
    assert (answer.code, answer.err.strip()) == (130, "error: interrupted")


@pytest.fixture
def default_signals() -> Iterator[None]:
    """The handlers of a fresh process: another command may have left its own."""
    before = {n: signal.signal(n, signal.SIG_DFL) for n in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def interrupted_patch(
    folder: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> Answer:
    """Run ``gapbridge patch``, to which the signal comes while it writes its output."""

    def write(path: Path, *_: object) -> None:
        with replacing(path) as file:
            file.write("half")
            signal.raise_signal(number)

    monkeypatch.setattr("gapbridge.bridge.cli.cell.patch.write_text", write)
    model, cell = folder / "arm.urdf", folder / "cell.yaml"
    shutil.copy(Path(__file__).parents[3] / "config" / "piper.urdf", model)
    cell.write_text("robot: {urdf: arm.urdf, tip: link6}\n", encoding="utf-8")
    return gapbridge("patch", model, "--cell", cell, "--out", folder / "new.urdf")


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_sigterm_and_a_closed_terminal_end_a_command_and_leave_no_partial_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals, code: int
) -> None:
    answer = interrupted_patch(tmp_path, monkeypatch, number)
    assert (answer.code, answer.err.strip()) == (code, "error: terminated")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.urdf", "cell.yaml"]
    assert signal.getsignal(number) is signal.SIG_DFL


@pytest.mark.usefixtures("default_signals")
def test_a_sighup_that_is_ignored_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``nohup gapbridge ...`` goes on behind a closed terminal."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    answer = interrupted_patch(tmp_path, monkeypatch, signal.SIGHUP)
    assert (answer.code, answer.err) == (0, "")
    assert (tmp_path / "new.urdf").read_text() == "half"


@pytest.mark.usefixtures("default_signals")
def test_the_daemon_keeps_its_own_signals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[object] = []
    numbers = (signal.SIGTERM, signal.SIGHUP)
    daemon(monkeypatch, lambda cell, **_: seen.extend(map(signal.getsignal, numbers)))
    assert gapbridge("run", cell_in(tmp_path)).code == 0
    assert seen == [signal.SIG_DFL, signal.SIG_DFL]


LOADING = """
import os, signal
os.kill(os.getpid(), signal.SIGINT)
for _ in range(1000): pass
print("loaded", flush=True)
"""
INTERRUPTED = f"""
import threading
from gapbridge.bridge.cli import main
def loading(*_, **__):
    exec({LOADING!r}, {{"__name__": "llvmlite.binding.executionengine"}})
    threading.Event().wait(60)
import gapbridge.bridge.cli.cell.check as command
command.check.callback = loading
main(["check", "cell.yaml"])
"""


IMPORTING = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == "gapbridge.bridge.cli":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
from gapbridge.__main__ import run
run()
"""


def test_an_interrupt_while_the_command_is_imported_is_one_line() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", IMPORTING], capture_output=True, text=True, check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )  # fmt: skip
    assert (ran.returncode, ran.stderr.strip()) == (130, "error: interrupted")


def test_an_interrupt_waits_until_machine_code_is_loaded() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", INTERRUPTED], capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}, timeout=120,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell may ignore it
    )  # fmt: skip
    assert ran.stdout == "loaded\n"
    assert (ran.returncode, ran.stderr.strip()) == (130, "error: interrupted")


def test_observing_and_writing_exclude_each_other(tmp_path: Path) -> None:
    line = refused("run", cell_in(tmp_path), "--observe", "--arm")
    assert "--observe: found beside --arm" in line


@pytest.mark.parametrize("duration", ["0", "-1", "soon"])
def test_a_duration_must_be_a_time(tmp_path: Path, duration: str) -> None:
    assert "--duration" in refused("run", cell_in(tmp_path), "--duration", duration)


def test_demo_wants_a_folder(tmp_path: Path) -> None:
    path = cell_in(tmp_path)
    assert "expected a folder" in refused("demo", "--out", path)


def test_the_benchmark_of_a_checkout_is_found() -> None:
    assert {"seeds", "quick"} <= {parameter.name for parameter in benchmark().params}


def test_where_there_is_no_checkout_the_help_says_that_one_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "benchmarks.blind", None)
    monkeypatch.delitem(sys.modules, "benchmarks.blind.__main__", raising=False)
    answer = gapbridge("blind", "--help")
    assert answer.code == 0
    assert "Example: gapbridge blind" in answer.out
    assert "needs a checkout" in " ".join(answer.out.split())
    assert gapbridge("blind").code == 1


@pytest.mark.parametrize(
    ("given", "phrase"),
    [
        (("--in-process", "nothere:f"), "found 'nothere:f', expected module:function"),
        (("--in-process", "json:f"), "module 'json' has no attribute 'f'"),
        (("--in-process", "json:__name__"), "found 'json:__name__', expected a function"),
        (("--command", ""), "--command: found '', expected a program"),
        (("--command", "'a"), "expected a program"),
        (("--seeds", 0), "'--seeds'"),
        (("--workers", 0), "'--workers'"),
    ],
)
def test_an_option_of_the_blind_benchmark_that_cannot_be_used_is_refused(
    given: tuple[object, ...], phrase: str
) -> None:
    assert phrase in refused("blind", *given, "--quick", "--kinds", "backlash")
