"""The output of a verification about what has changed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gapbridge.bridge.calibration.jobs.verify import VerifyJob
from gapbridge.bridge.cell.verification_mark import read_mark, write_mark
from gapbridge.core.calibration.result import Errors, Estimate
from gapbridge.core.calibration.verify import CandidateChange, Verification


class Lines:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def say(self, line: str = "", style: str = "") -> None:
        self.lines.append(line)

    warn = say


def suspect(joint: int, value: float) -> CandidateChange:
    name = f"joint_offset_{joint}"
    found = (Estimate(name, value, 2e-4, "rad"),)
    return CandidateChange(name, found, 0.4, 30.0, effect="joint_offset", joint=joint)


def said(*others: CandidateChange, moved: CandidateChange | None = None) -> list[str]:
    found = Verification(
        holds=False, errors=Errors(np.full((5, 3), 1e-3), np.arange(5)),
        predicted=np.full(5, 1e-4), ratio=9.0,
        chance=1e-9, moved=moved or suspect(4, 0.01), alternatives=others, stations=(), notes=(),
    )  # fmt: skip
    job = VerifyJob.__new__(VerifyJob)
    job.prompt = prompt = Lines()  # type: ignore[assignment]
    stops = [SimpleNamespace(stop=i) for i in (0, 4)]
    job.session = SimpleNamespace(accepted=stops)  # type: ignore[assignment]
    job._report(found)
    return prompt.lines


def test_other_joints_that_explain_as_much_are_named_with_their_size() -> None:
    lines = said(suspect(3, -0.02))
    (line,) = [line for line in lines if "cannot distinguish" in line]
    assert "the zero of joint 3 moved by 20 mrad" in line


@pytest.mark.parametrize("places", [1, 2])
def test_a_mark_is_kept_where_the_registered_instrument_was_moved(
    tmp_path: Path, places: int
) -> None:
    cell = tmp_path / "cell.yaml"
    write_mark(cell, "the zero of joint 1 moved by 10 mrad", tmp_path)
    job = VerifyJob.__new__(VerifyJob)
    job.prompt = prompt = Lines()  # type: ignore[assignment]
    job.cell = SimpleNamespace(  # type: ignore[assignment]
        path=cell, metrology=SimpleNamespace(registered=True)
    )
    job.session = SimpleNamespace(station_count=places)  # type: ignore[assignment]
    job._mark(SimpleNamespace(holds=True, cell_differs=False))  # type: ignore[arg-type]
    assert bool(read_mark(cell)) is (places == 2)
    assert any(("removed" if places == 1 else ": kept:") in line for line in prompt.lines)


def test_a_reading_that_does_not_fit_is_told_with_its_stop() -> None:
    lines = said(moved=CandidateChange("reading_2", (), 0.4, 30.0, reading=2))
    assert "  reading 2 is of stop 5" in lines


def test_no_alternative_is_named_if_the_readings_decide() -> None:
    assert not any("cannot distinguish" in line for line in said())
