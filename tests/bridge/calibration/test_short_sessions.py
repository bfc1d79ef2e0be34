"""The short sessions on a simulated arm, run in a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from cell_operator import CellOperator, Terminal, last_pose
from jogging_operator import JoggingOperator, answer_questions
from ports import own_host

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.demo.processes import ServedCell

BEGIN = np.array([0.2, -1.4, 1.6, -1.8, -1.5, 0.3])
LOAD = (4.0, (0.01, -0.02, 0.06))
CELL = """\
robot: {{model: ur10e}}
tool: {{tcp: {{xyz: {tcp}, rpy: [0.0, 0.0, 0.0]}}}}
payload: {{mass: 1.0, cog: [0.0, 0.0, 0.05]}}
metrology: {{registered: false, sigma: 3.0e-5}}
link: {{driver: ur_rtde, host: {host}}}
calibration: {{settle: 0.2, poses: 6, floor: -1.0, folder: sessions}}
simulation: {{seed: 3}}
"""
TRUE_TCP = (0.0, 0.0, 0.18)


def write_cell(folder: Path, name: str, host: str, tcp: tuple[float, ...]) -> Path:
    path = folder / name
    path.write_text(CELL.format(host=host, tcp=list(tcp)), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[JoggingOperator]:
    """Serve an arm; return an operator that jogs it."""
    folder, host = tmp_path_factory.mktemp("served"), own_host()
    cell = write_cell(folder, "served.yaml", host, TRUE_TCP)
    with ServedCell(cell, 3):
        yield JoggingOperator(CellOperator(host), load_cell(cell).model)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_payload_only_identifies_the_payload(served: JoggingOperator, tmp_path: Path) -> None:
    cell = write_cell(tmp_path, "cell.yaml", served.operator.host, TRUE_TCP)
    new = tmp_path / "new.yaml"
    served.jog(BEGIN)
    served.operator.mount(*LOAD, emit=False)  # the controller is not informed
    with Terminal(cell, "--payload-only", "--session", tmp_path / "s", "--apply", new) as terminal:
        shown = answer_questions(terminal, {
            "it is mounted": "",
            "rests there": lambda t: served.jog(last_pose(t.shown)),
            "[yes/no]": "yes",
        })  # fmt: skip
        assert terminal.code == 0, shown[-2000:]
    assert "the controller's payload is" not in shown
    payload = load_cell(new).file.payload
    assert payload.mass == pytest.approx(LOAD[0], abs=0.1)
    np.testing.assert_allclose(payload.cog, LOAD[1], atol=5e-3)
    assert list((tmp_path / "s").glob("*.html"))


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_tool_only_finds_the_tip_by_touching_one_point(
    served: JoggingOperator, tmp_path: Path
) -> None:
    cell = write_cell(tmp_path, "cell.yaml", served.operator.host, (0.004, -0.003, 0.172))
    new = tmp_path / "new.yaml"
    served.jog(BEGIN)
    point = served.pose()[0]

    def seated(terminal: Terminal) -> str:
        served.touch(last_pose(terminal.shown), point)
        return ""

    with Terminal(cell, "--tool-only", "--session", tmp_path / "s", "--apply", new) as terminal:
        shown = answer_questions(terminal, {
            "it is mounted": "", "tip on the point": seated, "[yes/no]": "yes",
        })  # fmt: skip
        assert terminal.code == 0, shown[-2000:]
    found = load_cell(new).model.tool_in_flange[:3, 3]
    np.testing.assert_allclose(found, TRUE_TCP, atol=2e-3)  # compliance is not in the readings
    assert list((tmp_path / "s").glob("*.html"))
