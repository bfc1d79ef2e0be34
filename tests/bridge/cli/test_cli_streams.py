"""The command line whose output is closed, full, left by its reader or of a narrow encoding."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from further import further

from gapbridge.bridge.cli.main import main


def closed() -> None:
    os.close(1)


def all_closed() -> None:
    os.closerange(0, 3)


def full() -> None:
    os.dup2(os.open("/dev/full", os.O_WRONLY), 1)


def left() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(writer, 1)


@pytest.mark.parametrize("unbuffered", ["", *further("1")])
@pytest.mark.parametrize(
    ("arguments", "stdout", "code", "err"),
    [
        (("explain", "backlash"), full, 1, "error: stdout: cannot be written: No space left"),
        (("--help",), full, 1, "error: stdout: cannot be written: No space left"),
        (("explain", "backlash"), left, 1, ""),
        (("explain", "backlash"), closed, 0, ""),
        (("check", "none.yaml"), closed, 2, "error: none.yaml: file not found"),
        (("check", "none.yaml"), all_closed, 2, ""),
    ],
)
def test_an_output_that_cannot_be_written_is_one_line_at_most(
    unbuffered: str, arguments: tuple[str, ...], stdout: Callable[[], None], code: int, err: str
) -> None:
    path = str(Path(__file__).parents[3])
    ran = subprocess.run(
        [sys.executable, "-m", "gapbridge", *arguments], preexec_fn=stdout, check=False,
        capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": unbuffered},
    )  # fmt: skip
    assert ran.returncode == code, ran.stderr
    assert ran.stderr.startswith(err)
    assert ran.stderr.count("\n") == bool(err)


def test_what_the_encoding_of_stdout_lacks_is_replaced(tmp_path: Path) -> None:
    cell, content = tmp_path / "\u4e09.yaml", io.BytesIO()
    cell.write_text("robot: {model: ur10e}\n")
    latin = io.TextIOWrapper(content, encoding="latin-1")
    with contextlib.redirect_stdout(latin), pytest.raises(SystemExit) as leaving:
        main(["check", str(cell)])
    assert leaving.value.code == 0
    assert b"?.yaml: fit to be used" in content.getvalue()


def test_a_closed_stdin_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        "robot: {model: ur10e}\ncalibration: {joints: typed}\n", encoding="utf-8"
    )  # the first question is where the arm stands
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(SystemExit) as leaving:
        main(["calibrate", str(cell), "--tool-only", "--session", str(tmp_path / "s")])
    assert leaving.value.code == 0
    assert "the input ended" in capsys.readouterr().out
