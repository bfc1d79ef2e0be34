"""Progress on stderr."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from patience import wait_for

from gapbridge.bridge.cli.progress import CompileProgress, status
from gapbridge.core.kernels import compiling
from gapbridge.core.kernels.machine_code import keep_by_all_sources


def test_compiling_is_said_at_once_and_then_now_and_again(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = iter([0.0, 3.0, 12.5, 14.0])
    said = CompileProgress(lambda: next(now))
    for functions in (1, 2, 9, 10):
        said(functions)
    assert capsys.readouterr().err.splitlines() == [
        "compiling for this machine, once: it takes a minute or two",
        "  9 functions, 12 s",
    ]


def test_what_is_compiled_is_heard_of_and_what_is_there_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from numba import njit

    keep_by_all_sources()
    heard: list[int] = []
    monkeypatch.setattr(compiling, "listeners", [heard.append])
    double = njit(lambda x: 2 * x)
    assert double(2.0) == 4.0
    first = len(heard)
    assert first >= 1
    assert double(3.0) == 6.0
    assert len(heard) == first
    double(np.ones(2))
    assert len(heard) > first
    assert heard == list(range(heard[0], heard[0] + len(heard)))


def test_names_of_effects_are_no_pictures(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    shown = [""]

    def drawn() -> bool:
        shown.append(capsys.readouterr().err)
        return "ft_bias" in "".join(shown)

    with status("diagnosing") as emit:
        emit("withheld:wrench:ft_bias")
        wait_for(drawn, "the name")
    assert "withheld:wrench:ft_bias" in "".join(shown)
