"""The real command in a terminal, against a simulated controller and its tracker."""

from __future__ import annotations

import json
import signal
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from cell_operator import FRAME, CellOperator, Terminal, last_pose
from ports import own_host

from benchmarks.calibration.kills import run as run_kills
from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.demo.processes import ServedCell
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.rotation import rotation_matrix

LOADS = ((1.5, (0.0, 0.0, 0.05)), (9.5, (0.0, 0.0, 0.09)))
CELL = """\
robot: {{model: ur10e}}
tool: {{tcp: {{xyz: [0.0, 0.0, 0.18], rpy: [0.0, 0.0, 0.0]}}}}
payload: {{mass: 1.5, cog: [0.0, 0.0, 0.05]}}
metrology: {{registered: false, sigma: 2.0e-5}}
link: {{driver: ur_rtde, host: {host}}}
calibration:
  instrument: {instrument}
  loads: [{{mass: 1.5, cog: [0, 0, 0.05]}}, {{mass: 9.5, cog: [0, 0, 0.09]}}]
  effects: [axial_compliance]
  poses: {poses}
  held_out: 8
  repeats: 2
  floor: 0.1
  joint_range: {{lower: [-1.2, -2.4, 0.4, -2.8, -2.4, -1.5], upper: [1.2, -0.6, 2.3, -0.6, -0.8, 1.5]}}
  settle: 0.2
  speed: 1.5
  folder: sessions
simulation: {{seed: 3}}
"""  # noqa: E501


def write_cell(folder: Path, instrument: str, poses: int) -> tuple[Path, str]:
    host = own_host()
    path = folder / "cell.yaml"
    path.write_text(CELL.format(host=host, instrument=instrument, poses=poses), encoding="utf-8")
    return path, host


@dataclass
class Person:
    """Answers the questions, with ``mistakes`` (number of the reading -> mistake)."""

    operator: CellOperator
    mistakes: dict[int, str] = field(default_factory=dict)
    read: int = 0

    def answer(self, terminal: Terminal, question: str) -> str | None:
        """Return the input line; None: the arm is jogged instead."""
        if "it is mounted" in question:
            second = terminal.shown.rfind("9.5 kg, centre") > terminal.shown.rfind("1.5 kg, centre")
            self.operator.mount(*LOADS[second])
            return ""
        if "rests there" in question:
            self.operator.jog(last_pose(terminal.shown))
            return None
        if question.startswith("x y z"):
            return self._reading()
        if question.startswith("what now"):
            reported = terminal.shown[terminal.shown.rfind("a good reading is within") :]
            return "" if "alone is off" in reported else "back"
        if question.startswith("which"):
            return ""
        assert "[yes/no]" in question, question
        return "yes"

    def _reading(self) -> str | None:
        self.read += 1
        mistake = self.mistakes.pop(self.read, "")
        if mistake == "power cut":
            return None
        if mistake == "knock":
            turn = rotation_matrix(np.array([0.1, -0.2, 0.702]))
            self.operator.frame = Registration(
                turn, FRAME.position + np.array([2e-3, 1e-3, -1.5e-3])
            )
        value = self.operator.measure() * (1e3 if mistake == "mm" else 1.0)
        if mistake == "typo":
            value[1] += 0.09
        return " ".join(f"{v:.6f}" for v in value)

    def answer_questions(self, terminal: Terminal) -> bool:
        """Answer until the command ends; return False after a simulated power cut."""
        for _ in range(200):
            question = terminal.question()
            if question is None:
                return True
            before = self.read
            typed = self.answer(terminal, question)
            if typed is not None:
                terminal.type(typed)
            elif self.read != before:
                terminal.signal(signal.SIGKILL)
                return False
        raise AssertionError(f"200 questions, and no end: {terminal.shown[-2000:]}")


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_mistakes_and_a_power_cut_end_with_a_valid_cell(tmp_path: Path) -> None:
    cell, host = write_cell(tmp_path, "{kind: typed, unit: m}", 12)
    new, session = tmp_path / "new.yaml", tmp_path / "s"
    person = Person(CellOperator(host), {4: "mm", 6: "typo", 9: "knock", 15: "power cut"})
    with ServedCell(cell, 3):
        with Terminal(cell, "--session", session) as terminal:
            assert not person.answer_questions(terminal), terminal.shown[-2000:]
            first = terminal.shown
        kept = sum(e["kind"] == "reading" for e in read_entries(session / FILE))
        assert kept == first.count("  kept  ") + 3  # the poses that `back` measured again
        with Terminal(cell, "--session", session, "--apply", new) as terminal:
            assert person.answer_questions(terminal), terminal.shown[-2000:]
            assert terminal.code == 0, terminal.shown[-2000:]
    assert "is the unit right?" in first
    assert "alone is off" in first
    assert "the instrument has moved" in first
    assert "resuming the session" in terminal.shown
    axial = load_cell(new).model.compliance()[0]
    true = load_cell(cell)
    from gapbridge.bridge.cell.simulation import server_settings

    hidden = server_settings(true, host, 3).plant.axial
    assert axial[1] == pytest.approx(hidden[1], abs=2e-6)
    assert axial[2] == pytest.approx(hidden[2], abs=2e-6)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_arm_moves_after_confirmation_and_ctrl_c_shows_how_to_resume(tmp_path: Path) -> None:
    cell, host = write_cell(tmp_path, "{kind: simulated_tracker}", 8)
    # where the arm begins it hangs low: above a near floor no straight way would be free
    cell.write_text(cell.read_text().replace("floor: 0.1", "floor: -1.0"), encoding="utf-8")
    operator = CellOperator(host)
    with ServedCell(cell, 3), Terminal(cell, "--session", tmp_path / "s", "--move") as terminal:
        assert "it is mounted" in str(terminal.question())
        before = json.loads(operator.bench("truth"))["rigid_tcp"]
        terminal.type("")
        assert "Move it?" in str(terminal.question())
        assert json.loads(operator.bench("truth"))["rigid_tcp"] == pytest.approx(before, abs=1e-4)
        terminal.type("yes")
        broken = 0
        while terminal.shown.count("  kept  ") < 1:
            terminal.read_output()
            if terminal.shown.count("Continue from here") > broken:  # the machine missed deadlines
                broken += 1
                terminal.type("yes")
        terminal.signal(signal.SIGINT)
        shown = terminal.wait_for_end()
        assert terminal.code == 130
    assert "the controller's payload is" not in shown  # the simulated tracker hangs each load
    assert "interrupted" in shown
    assert "to resume: gapbridge calibrate" in shown
    kept = [e for e in read_entries(tmp_path / "s" / FILE) if e["kind"] == "reading"]
    assert kept
    assert all(e["samples"] == 10 for e in kept)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_no_reading_is_lost_by_kill_9_and_the_session_always_resumes() -> None:
    tally = run_kills(kills=5, seed=1, say=False)
    assert tally.acknowledged > 0
    assert (tally.lost, tally.refused) == (0, 0)
