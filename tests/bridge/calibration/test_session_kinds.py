"""Complete sessions with every kind of instrument, run by the command."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE
from scripted_session import (
    AXIAL,
    FRAME,
    CommandResult,
    plan_in,
    reading_line,
    run_calibrate,
    truth,
    write_cell,
)

from gapbridge.bridge.calibration.planning import observable_of
from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.accuracy_baseline import read_baseline
from gapbridge.core.calibration.observables.fixed_point import fixed_at
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.predicted_readings import predicted_readings
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads

APPROXIMATE_POINT = np.array([0.7, 0.25, 0.5])  # m, as declared in the cell
TRUE_POINT = np.array([0.704, 0.247, 0.505])  # m
CONTACT_NOISE = 1e-5  # rad, 1 sigma of the joint angles in contact
OFFSETS = {"joint_offset_2": 8e-4, "joint_offset_3": -6e-4, "joint_offset_5": 5e-4}


@dataclass
class Session:
    """A planned session, and the readings of its instrument at each stop."""

    folder: Path
    cell: Path
    plan: Plan
    readings: Readings

    def lines(self, *each: Callable[[int], str]) -> list[str]:
        """Return the input: one line from each of ``each`` per stop, Enter for each load."""
        lines, mounted = [], None
        for i, pose in enumerate(self.plan.poses):
            if pose.load != mounted:
                lines.append("")
                mounted = pose.load
            lines += [line(i) for line in each]
        return [*lines, "yes"]

    def run(self, lines: list[str]) -> CommandResult:
        result = run_calibrate(
            self.cell, "--session", self.folder / "s", "--apply", self.folder / "new.yaml",
            lines=lines,
        )  # fmt: skip
        assert result.code == 0, result.err + result.out[-1500:]
        assert (self.folder / "new.yaml").exists(), result.out[-4000:]
        return result


def planned_session(
    folder: Path, instrument: str, poses: int, nuisance: Nuisance, joints: str = "planned",
    tool: tuple[float, float, float] | None = None,
) -> Session:  # fmt: skip
    """Plan a session and simulate its readings with noise."""
    cell = write_cell(folder, instrument=instrument, joints=joints, poses=poses)
    with cell.open("a", encoding="utf-8") as file:
        file.write(f"  instrument_at: {APPROXIMATE_POINT.tolist()}\n  floor: -0.2\n")
    assert run_calibrate(cell, "--plan-only", "--session", folder / "s").code == 0
    plan, loaded = plan_in(folder / "s"), load_cell(cell)
    load = np.array([p.load for p in plan.poses])
    count = len(load)
    blank = Readings(
        loaded.calibration.instrument.measures, np.array([p.q for p in plan.poses]),
        np.zeros((count, 0)), np.full(count, np.nan),
        Loads(
            payload_mass=np.array([one.mass for one in plan.loads])[load],
            payload_cog=np.array([one.cog for one in plan.loads])[load],
        ),
        load, np.zeros(count, dtype=np.int64), np.array([p.target for p in plan.poses]),
        np.zeros(count, dtype=bool), np.arange(count),
    )  # fmt: skip
    observable = observable_of(loaded, loaded.calibration.instrument)
    readings = predicted_readings(observable, truth(), blank, nuisance)
    assert len(readings) == count
    random = np.random.default_rng(5)
    readings.value[:] += random.normal(0, 2e-5, readings.value.shape)
    readings.q[:] += random.normal(0, CONTACT_NOISE, readings.q.shape) if observable.closes else 0.0
    return Session(folder, cell, plan, readings)


def check_identified(session: Session, result: CommandResult, of: str = "") -> None:
    """Check that the true parameters are within five sigmas of the identified ones."""
    assert load_cell(session.folder / "new.yaml").model.terms
    assert (session.folder / "s" / "calibration.html").exists()
    assert "kept" in result.out
    reported = json.loads((session.folder / "s" / "promise.json").read_text())
    baseline = read_baseline(reported)
    true = {**OFFSETS, **{f"axial_compliance_{i + 1}": c for i, c in enumerate(AXIAL)}}
    error = baseline.values - [true.get(name, 0.0) for name in baseline.names]
    selected = np.array([name.startswith(of) for name in baseline.names])
    assert (np.abs(error) < 5.0 * np.sqrt(np.diag(baseline.covariance)))[selected].all(), (
        baseline.names
    )
    assert {"axial_compliance_2", "axial_compliance_3"} <= set(baseline.names)


def fixed_point_frame(length: float = 0.0, balls: int = 1) -> Nuisance:
    return Nuisance((fixed_at(TRUE_POINT),), np.zeros((balls, 3)), np.array([length]))


def in_degrees(q: np.ndarray) -> str:
    return " ".join(f"{v:.6f}" for v in np.degrees(q))


@pytest.mark.slow
def test_a_dial_gauge_of_unknown_zero(tmp_path: Path) -> None:
    session = planned_session(tmp_path, "{kind: dial_gauge, unit: mm}", 26, fixed_point_frame(0.2))
    dial = [f"{1e3 * v:.3f}" for v in session.readings.value[:, 0]]
    check_identified(session, session.run(session.lines(lambda i: dial[i])))


@pytest.mark.slow
def test_two_balls_measured_in_an_unknown_frame(tmp_path: Path) -> None:
    balls = Nuisance((FRAME,), np.array([[0.0, 0.0, 0.0], [0.21, 0.02, 0.0]]), np.zeros(1))
    session = planned_session(tmp_path, "{kind: two_balls, unit: in}", 16, balls)
    first = np.random.default_rng(1).uniform(-2, 2, session.readings.value.shape)
    second = first + session.readings.value
    result = session.run(session.lines(
        lambda i: reading_line(first[i], 1 / 0.0254), lambda i: reading_line(second[i], 1 / 0.0254)
    ))  # fmt: skip
    # of the zeros of parallel joints only the sum is identifiable
    check_identified(session, result, of="axial_compliance")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("instrument", "poses", "radius"),
    [("{kind: sphere, radius: 0.03}", 28, 0.03), ("{kind: point}", 16, 0.0)],
)
def test_contact_with_joint_angles_alone(
    tmp_path: Path, instrument: str, poses: int, radius: float
) -> None:
    session = planned_session(
        tmp_path, instrument, poses, fixed_point_frame(radius), joints="typed"
    )
    q = session.readings.q
    check_identified(session, session.run(session.lines(lambda i: "", lambda i: in_degrees(q[i]))))


@pytest.mark.slow
def test_files_that_the_trackers_software_exports(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    session = planned_session(
        tmp_path, "{kind: folder, unit: mm, folder: out, pattern: 'M*.txt'}", 14,
        Nuisance((FRAME,), np.zeros((1, 3)), np.zeros(1)),
    )  # fmt: skip
    since = read_entries(tmp_path / "s" / FILE)[0]["time"]
    for i, value in enumerate(session.readings.value):
        # names are not in the order of the files, and other files are in the folder
        path = out / f"M{(7 * i) % 97}.txt"
        point = ";".join(f"{1e3 * v:.4f}".replace(".", ",") for v in value)
        path.write_text(f"X;Y;Z\n{point}\n", encoding="utf-8")
        os.utime(path, (since + 1e-3 * i, since + 1e-3 * i))
    (out / "log.csv").write_text("nothing", encoding="utf-8")
    check_identified(session, session.run(session.lines()))


@pytest.fixture
def feed() -> Iterator[tuple[int, list[np.ndarray]]]:
    """Serve lines: each connection gets one reading, repeated for each request."""
    values: list[np.ndarray] = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=_serve, args=(server, values), daemon=True)
        thread.start()
        yield server.getsockname()[1], values
        server.shutdown(socket.SHUT_RDWR)
    thread.join(PATIENCE)


def _serve(server: socket.socket, values: list[np.ndarray]) -> None:
    random, number = np.random.default_rng(3), 0
    while True:
        try:
            link, _ = server.accept()
        except OSError:
            return
        with link, link.makefile() as lines:
            asked = False
            for _ in lines:
                value = 1e3 * (values[number] + random.normal(0, 1e-5, 3))
                link.sendall((" ".join(f"{v:.5f}" for v in value) + "\r\n").encode())
                asked = True
            number += asked


@pytest.mark.slow
def test_lines_that_the_trackers_software_sends_on_demand(
    tmp_path: Path, feed: tuple[int, list[np.ndarray]]
) -> None:
    port, values = feed
    session = planned_session(
        tmp_path, f"{{kind: line_feed, unit: mm, port: {port}, trigger: MEASURE}}", 14,
        Nuisance((FRAME,), np.zeros((1, 3)), np.zeros(1)),
    )  # fmt: skip
    values.extend(session.readings.value)
    result = session.run(session.lines(lambda i: ""))
    assert "mean of 10" in result.out
    check_identified(session, result)


def test_contact_readings_need_joint_angles(tmp_path: Path) -> None:
    session = planned_session(tmp_path, "{kind: point}", 12, fixed_point_frame(), joints="typed")
    lines = ["", "", "", in_degrees(session.readings.q[0])]  # load, contact, Enter for the joints
    result = run_calibrate(session.cell, "--session", tmp_path / "s", lines=lines)
    assert "found nothing, expected where the arm stands now" in result.out
    session.cell.write_text(session.cell.read_text().replace("joints: typed", "joints: planned"))
    result = run_calibrate(session.cell, "--session", tmp_path / "s", lines=lines)
    assert result.code == 2
    assert "the joints are the reading" in result.err
