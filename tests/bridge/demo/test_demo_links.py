"""The demo on CAN and over Modbus: the same steps and summary, over the real protocols."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from patience import PATIENCE

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.demo.links import LINKS, DemoLink
from gapbridge.bridge.demo.links.modbus import travel_time
from gapbridge.bridge.demo.measurements import measurements_at, write_log
from gapbridge.bridge.demo.poses import candidates, plan
from gapbridge.core.errors import LinkError
from gapbridge.core.log.log import read_log
from gapbridge.drivers.simulated.plant.kinematics import within_limits
from gapbridge.drivers.simulated.plant.motion import MoveJoints
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.server.arm_controller import OWN_ACCELERATION, OWN_SPEED
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

ROOT = Path(__file__).parents[3]
OTHERS = ("can", "modbus")


@pytest.fixture(params=OTHERS)
def link(request: pytest.FixtureRequest, tmp_path: Path) -> DemoLink:
    return LINKS[request.param](tmp_path, 3)


def test_every_link_is_named_as_its_cells_driver(tmp_path: Path) -> None:
    for name, kind in LINKS.items():
        found = kind(tmp_path, 1).cell.link
        assert found is not None
        assert found.driver == name == kind.name


def test_the_demos_piper_is_the_one_that_users_copy() -> None:
    ours, theirs = (ROOT / p / "piper.urdf" for p in ("bridge/demo", "config"))
    assert ours.read_text() == theirs.read_text()


@pytest.mark.parametrize("seed", [1, 2, 8])
def test_poses_are_within_the_arms_limits_and_there_are_enough(link: DemoLink, seed: int) -> None:
    wanted, model = link.experiment, link.cell.model
    given = plan(model, link.home, seed, wanted)
    arm = plant_arm(link.cell.arm)
    assert [len(q) for q in given.calibration] == [wanted.calibration_poses] * len(
        given.calibration
    )
    assert [len(q) for q in given.test] == [wanted.test_poses * times for times in wanted.visits]
    for poses in (given.calibration, given.test):
        assert all(within_limits(arm, q.tolist()) for q in np.vstack(poses))
    far = model.rigid_pose(np.vstack(given.test)).position
    assert np.hypot(far[:, 0], far[:, 1]).min() > wanted.workspace.far
    assert len(candidates(model, seed, wanted.workspace)) > 100


def test_what_is_hidden_stands_in_no_cell_that_the_run_reads(link: DemoLink) -> None:
    declared = link.declared(link.cell, link.experiment.test_loads[0])
    for cell in (link.cell, declared):
        assert cell.file.simulation.compliance is None
        assert cell.file.simulation.tool_shift is None
        assert cell.model.terms == ()
    assert declared.model.payload_mass == link.experiment.test_loads[0].mass
    assert declared.model.payload_cog.tolist() == list(link.experiment.test_loads[0].cog)


def test_another_seed_hides_another_piper_and_the_same_seed_the_same(tmp_path: Path) -> None:
    first, again, other = (LINKS["can"](tmp_path, s)._simulation_lines() for s in (1, 1, 2))  # type: ignore[attr-defined]
    assert first == again != other


def test_what_one_count_comes_to_is_reported(tmp_path: Path) -> None:
    can, modbus = (LINKS[name](tmp_path, 1) for name in OTHERS)
    wire = np.radians(0.001)
    assert can.resolution().written == pytest.approx(wire * can.cell.model.length)
    assert modbus.resolution().written == 1e-6
    assert modbus.resolution().read == pytest.approx(1e-3 * modbus.cell.model.length)


@pytest.mark.parametrize("way", [0.003, 0.2, 0.25, 1.3])
def test_the_programs_travel_time_is_that_of_the_robots_move(way: float) -> None:
    goal, q, dt, steps = (0.0, -way), (0.0, 0.0), 0.001, 0
    motion = MoveJoints(q, goal, OWN_SPEED, OWN_ACCELERATION)
    while not motion.done:
        q, steps = motion.step(q, q, dt), steps + 1
    assert travel_time(np.zeros(2), np.array(goal)) == pytest.approx(steps * dt, abs=2e-3)


def test_the_bench_moves_the_arm_and_stamps_with_this_machines_clock(tmp_path: Path) -> None:
    link = LINKS["modbus"](tmp_path, 3)
    goal = link.home + np.array([0.1, 0.05, -0.05, 0.0, 0.0, 0.1])
    with link.served():
        bench = link.bench()
        load = link.experiment.test_loads[1]
        bench.attach(load)
        bench.move_to(goal, travel_time(link.home, goal))
        before = time.monotonic()
        reading = bench.measure()
        assert before <= reading[0] <= time.monotonic()
        wanted = link.cell.model.rigid_pose(goal[None]).position[0]
        deflected = np.linalg.norm(reading[1:4] - wanted)
        assert 2e-4 < deflected < 4e-3
        with pytest.raises(LinkError, match="move: outside the joint limits"):
            bench.move_to(goal + 20.0)
        bench.close()


def test_a_load_that_no_controller_reports_goes_into_the_log(tmp_path: Path) -> None:
    load = LINKS["can"].experiment.calibration_loads[2]
    t, q = np.arange(0, 2, 0.01), np.full((200, 6), 0.4)
    recording = {"timestamp": t, "actual_q": q, "actual_qd": 0 * q}
    readings = np.column_stack([t, np.tile([0.1, 0.2, 0.3, 0.0, 0.0, 1.0], (200, 1))])
    found, missing = measurements_at(recording, readings, q[:1] + 0.001, load)
    assert found is not None, missing
    write_log(tmp_path / "both.csv", found)
    write_log(tmp_path / "sent.csv", found, joints=False)
    both, sent = (read_log(tmp_path / name, 6) for name in ("both.csv", "sent.csv"))
    np.testing.assert_allclose(sent.require("payload"), [load.mass])
    np.testing.assert_allclose(sent.require("payload_cog"), [load.cog])
    assert sent.require("target_q")[0] == pytest.approx(0.401)
    assert both.require("actual_q")[0] == pytest.approx(0.4)
    assert "actual_q" not in sent.columns


class Shown(NamedTuple):
    """A demo that ran through the real command."""

    out: Path
    code: int
    reported: str


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Shown]:
    """The demos of the other links, run in parallel: each mostly waits for its arm."""
    folder = tmp_path_factory.mktemp("demos")
    running = []
    for name in OTHERS:
        reported = folder / f"{name}.txt"
        command = [sys.executable, "-m", "gapbridge", "demo", "--link", name, "--seed", "3"]
        with reported.open("w") as output:
            running.append(subprocess.Popen(
                [*command, "--out", str(folder / name)], stdout=output, stderr=output, cwd=folder,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            ))  # fmt: skip
        until = time.monotonic() + 60  # both would take the same address before one serves there
        while "measuring" not in reported.read_text() and time.monotonic() < until:
            time.sleep(0.2)
    codes = [demo.wait(600) for demo in running]
    return {
        name: Shown(folder / name, code, (folder / f"{name}.txt").read_text())
        for name, code in zip(OTHERS, codes, strict=True)
    }


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", OTHERS)
def test_the_demo_shows_on_every_link_what_it_states(name: str, shown: dict[str, Shown]) -> None:
    out, code, reported = shown[name]
    assert code == 0, reported
    summary = json.loads((out / "summary.json").read_text())
    error, repeats = summary["tcp_error_mm"], summary["repeatability_mm"]
    assert summary["link"] == name
    assert error["without"]["rms"] > 20 * error["with"]["rms"]
    # both floors are the link's and the arm's own; a few visits determine repeatability to a third
    floor = np.hypot(repeats, summary["resolution_mm"])
    assert error["with"]["rms"] < 2.0 * floor
    assert 0.01 < repeats < 0.1
    assert 0.0 < summary["resolution_mm"] < 0.02
    assert "resolution at the TCP" in " ".join(reported.split())
    slower = 2 ** " ".join(reported.split()).count(" of the rate")
    assert summary["setpoints_written"] > 4_000 / slower
    loop = summary["loop"]  # by the controller's clock, with the cycles that a busy machine misses
    assert loop["rate_hz"] * loop["cycles"] / (loop["cycles"] - loop["missed"]) > 40 / slower
    assert load_cell(out / "cell.yaml").model.terms == ()
    assert len(load_cell(out / "calibrated.yaml").model.terms) > 4
    diagnosis = json.loads((out / "diagnosis" / "diagnosis.json").read_text())
    assert diagnosis["verdict"] in ("explained", "partly_explained")
    assert error["fitted"]["rms"] > 10 * error["with"]["rms"]  # a bent tool, which no fit knows
    for key, true in summary["hidden"].items():
        near = pytest.approx(true, rel=0.05) if "droop" in key else pytest.approx(true, abs=6e-5)
        assert summary["accused"][key]["value"] == near
    joints = summary["joint_error_mrad"]
    if name == "can":  # servos that give way
        assert 3.5 < joints["without"]["max"] < 6.0
        assert joints["without"]["rms"] > 20 * joints["with"]["rms"]
        assert "joint error at rest" in " ".join(reported.split())
    else:
        assert joints is None
    assert len(read_log(out / "calibration.csv", 6)) == summary["samples"]
    assert "bending drawn" in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_demo_that_is_killed_leaves_no_controller_behind(tmp_path: Path) -> None:
    script = (
        "import sys, time; from pathlib import Path\n"
        "from gapbridge.bridge.demo.links import LINKS\n"
        "link = LINKS['can'](Path(sys.argv[1]), 1)\n"
        "with link.served():\n    print(link.host, flush=True); time.sleep(60)\n"
    )
    demo = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert demo.stdout is not None
    host = demo.stdout.readline().strip()
    with socket.create_connection((host, BENCH_PORT), timeout=PATIENCE):
        demo.kill()
        demo.wait()
    demo.stdout.close()
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        try:
            socket.create_connection((host, BENCH_PORT), timeout=PATIENCE).close()
        except OSError:
            return
        time.sleep(0.1)
    pytest.fail("the simulated controller still serves")
