"""The commands, run as people run them."""

from __future__ import annotations

import importlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from further import further
from patience import PATIENCE
from ports import own_host

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cli import main
from gapbridge.bridge.cli.table import COMMANDS
from gapbridge.bridge.document.output_file import replacing_bytes
from gapbridge.core.compensation import correct
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import read_log
from gapbridge.core.model import Model

CELL = "robot: {model: ur10e}\ntool: {tcp: {xyz: [0, 0, 0.18]}}\nmetrology: {registered: true}\n"
SOFT = (
    CELL
    + """
compliance:
  axial: [3e-6, 4e-6, 5e-6, 8e-6, 1e-5, 1e-5]
  radial: [5e-7, 6e-7, 8e-7, 1e-6, 2e-6, 2e-6]
"""
)


class Ran(NamedTuple):
    code: int
    out: str
    err: str


class Desk:
    """A folder with a cell and a log in it, and the command line."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capsys = capsys
        self.write("cell.yaml", SOFT)
        self.write("rigid.yaml", CELL)

    def write(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text, encoding="utf-8")
        return path

    def run(self, *given: str) -> Ran:
        arguments = [str(self.folder / w[1:]) if w.startswith("@") else w for w in given]
        with pytest.raises(SystemExit) as left:
            main(arguments)
        out, err = self._capsys.readouterr()
        code = left.value.code
        return Ran(code if isinstance(code, int) else 0, out, err)

    def refuses(self, *given: str) -> str:
        """Run what must be refused; returns the one line on stderr."""
        ran = self.run(*given)
        assert ran.code == 2, ran
        assert "Traceback" not in ran.err
        assert ran.err.count("\n") == 1
        assert ran.out == ""
        return ran.err


@pytest.fixture
def desk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Desk:
    return Desk(tmp_path, capsys)


def poses(count: int, seed: int = 0) -> np.ndarray:
    home = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
    return home + np.random.default_rng(seed).uniform(-0.6, 0.6, (count, 6))


def csv(**columns: np.ndarray) -> str:
    names, parts = [], []
    for name, values in columns.items():
        values = np.asarray(values, dtype=float)
        names += [name] if values.ndim == 1 else [f"{name}_{i}" for i in range(values.shape[1])]
        parts.append(values.reshape(len(values), -1))
    rows = [",".join(f"{v:.17g}" for v in row) for row in np.hstack(parts)]
    return "\n".join([",".join(names), *rows]) + "\n"


def measured_log(model: Model, count: int = 40, noise: float = 2e-5) -> str:
    random, q = np.random.default_rng(1), poses(count)
    mass = np.tile([0.0, 5.0, 10.0], count)[:count]
    cog = np.tile([0.0, 0.0, 0.06], (count, 1))
    real = model.predict(q, Loads(payload_mass=mass, payload_cog=cog)).position
    real = real + random.normal(0, noise, real.shape)
    return csv(actual_q=q, payload=mass, payload_cog=cog, measured_position=real)


# -- the table ---------------------------------------------------------------------------------


def test_help_names_every_command(desk: Desk) -> None:
    ran = desk.run("--help")
    for name, (_, line) in COMMANDS.items():
        assert name in ran.out
        assert line in ran.out


HEAVY = ("numpy", "numba", "scipy", "pydantic", "yaml", "rich", "pyarrow")  # 0.03 to 0.5 s each
AT_ONCE = ["run", "status", "arm", "disarm", "blind", "explain"]  # or read a cell only when called


def heavy_after(code: str) -> str:
    """Return which of the heavy libraries a fresh process has imported after some code."""
    code = f"import sys\ntry:\n    {code}\nexcept SystemExit:\n    pass\n"
    code += f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return ran.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "arguments", [["--help"], ["--version"], ["explain"], ["status"], ["status", "cell.yaml"]]
)
def test_what_answers_at_once_imports_nothing_heavy(arguments: list[str]) -> None:
    assert heavy_after(f"from gapbridge.bridge.cli import main; main({arguments})") == "[]"


@pytest.mark.parametrize("name", AT_ONCE)
def test_a_command_imports_nothing_heavy_for_the_sake_of_others(name: str) -> None:
    module = COMMANDS[name][0].partition(":")[0]
    assert heavy_after(f"import {module}") == "[]"


@pytest.mark.parametrize("name", ["run", "diagnose", *further("predict", "fit")])
def test_a_command_waits_for_no_solver_before_it_has_work(desk: Desk, name: str) -> None:
    code = (
        f"import sys\nimport {COMMANDS[name][0].split(':')[0]}\n"
        "found = {'scipy.optimize', 'scipy.linalg', 'scipy.stats'} & set(sys.modules)\n"
        "assert not found, found\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(desk: Desk, name: str) -> None:
    ran = desk.run(name, "--help")
    assert ran.code == 0
    assert "Example" in ran.out
    assert desk.run(name, "-h").out == ran.out
    assert "config/" not in ran.out  # which a wheel has not


@pytest.mark.parametrize("name", COMMANDS)
def test_the_line_of_a_command_is_the_first_of_its_help(name: str) -> None:
    module, attribute = COMMANDS[name][0].split(":")
    command = getattr(importlib.import_module(module), attribute)
    assert command.name == name
    line, reported = COMMANDS[name][1].rstrip("."), " ".join(command.help.split())
    assert reported.startswith(line) or name in ("diagnose", "blind")


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        (["predct", "x"], "'predict'"),
        (["fit"], "Missing argument 'LOG...'"),
        (["fit", "x", "--cel", "y"], "--cell"),
        (["predict", "@log.csv", "--cell", "@cell.yaml"], "--out"),
        (
            ["predict", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.xlsx"],
            "found .xlsx, expected .csv or .parquet",
        ),
        (
            ["compensate", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv.gz"],
            "found .gz, expected .csv or .parquet",
        ),
    ],
)
def test_a_slip_on_the_command_line_is_reported_in_one_line(
    desk: Desk, given: list[str], hint: str
) -> None:
    assert hint in desk.refuses(*given)


def test_version_is_reported(desk: Desk) -> None:
    ran = desk.run("--version")
    assert ran.code == 0
    assert ran.out.startswith("gapbridge")


# -- predict and compensate ---------------------------------------------------------------------


def test_predict_writes_the_columns_of_the_contract(desk: Desk) -> None:
    q = poses(5)
    wrench = np.random.default_rng(2).normal(0, 20, (5, 6))
    columns = {"actual_TCP_force": wrench, "payload": np.arange(5.0), "moon": np.ones(5)}
    desk.write("log.csv", csv(target_q=q + 1, actual_q=q, **columns))
    ran = desk.run("predict", "@log.csv", "--cell", "@cell.yaml", "--out", "@out.csv")
    assert (ran.code, ran.err) == (0, "")
    header, *_ = (desk.folder / "out.csv").read_text().splitlines()
    assert header == ",".join(
        f"predicted_{kind}_{i}" for kind in ("position", "rotation") for i in range(3)
    )
    table = np.loadtxt(desk.folder / "out.csv", delimiter=",", skiprows=1)
    model = load_cell(desk.folder / "cell.yaml").model
    expected = model.predict(q, read_log(desk.folder / "log.csv", 6).loads())
    np.testing.assert_array_equal(table[:, :3], expected.position)
    np.testing.assert_array_equal(table[:, 3:], expected.rotation_vector)


def test_compensate_takes_targets_and_meets_the_wanted_pose(desk: Desk) -> None:
    q = poses(7)
    desk.write("log.csv", csv(target_q=q, actual_q=q + 0.2, payload=np.full(7, 5.0)))
    ran = desk.run("compensate", "@log.csv", "--cell", "@cell.yaml", "--out", "@out.csv")
    assert (ran.code, ran.err) == (0, "")
    lines = (desk.folder / "out.csv").read_text().splitlines()
    assert lines[0] == ",".join(f"corrected_q_{i}" for i in range(6))
    corrected = np.loadtxt(lines[1:], delimiter=",")
    model = load_cell(desk.folder / "cell.yaml").model
    loads = read_log(desk.folder / "log.csv", 6).loads()
    reached, wanted = model.predict(corrected, loads), model.rigid_pose(q)
    assert np.abs(reached.position - wanted.position).max() < 1e-8
    assert np.abs(model.predict(q, loads).position - wanted.position).max() > 1e-4


@pytest.mark.parametrize(
    ("command", "column"), [("predict", "target_q"), ("compensate", "actual_q")]
)
def test_the_other_joints_are_taken_where_the_first_are_missing(
    desk: Desk, command: str, column: str
) -> None:
    q = poses(3)
    desk.write("log.csv", csv(**{column: q}))
    assert desk.run(command, "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv").code == 0
    table = np.loadtxt(desk.folder / "o.csv", delimiter=",", skiprows=1)
    model = load_cell(desk.folder / "cell.yaml").model
    expected = model.predict(q).position if command == "predict" else correct(model, q).q
    np.testing.assert_allclose(table[:, : expected.shape[1]], expected, atol=1e-12)


def test_a_rigid_cell_corrects_nothing(desk: Desk) -> None:
    q = poses(4)
    desk.write("log.csv", csv(target_q=q))
    desk.run("compensate", "@log.csv", "--cell", "@rigid.yaml", "--out", "@o.csv")
    np.testing.assert_array_equal(np.loadtxt(desk.folder / "o.csv", delimiter=",", skiprows=1), q)


def test_a_pose_out_of_reach_is_reported_and_the_rest_written(desk: Desk) -> None:
    stretched = np.zeros((1, 6))
    q = np.vstack([poses(2), stretched])
    desk.write("log.csv", csv(target_q=q, payload=np.full(3, 12.0)))
    ran = desk.run("compensate", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv")
    assert ran.code == 0
    assert "row 4 misses it most" in ran.err
    assert np.isfinite(np.loadtxt(desk.folder / "o.csv", delimiter=",", skiprows=1)).all()


@pytest.mark.parametrize(
    ("limits", "scale", "phrase"),
    [
        ("", 30, "row 2: the correction moves the TCP by"),
        ("", 250, "row 2: the corrected setpoint misses the wanted pose by"),
        ("limits: {joint_offset: 1e-5}", 1, "expected at most 1e-05 rad (limits.joint_offset of"),
        ("limits: {offset: 1e-5}", 1, "expected at most 0.01 mm (limits.offset of"),
        (
            "limits: {offset_rotation: 1e-5}",
            1,
            "expected at most 1e-05 rad (limits.offset_rotation",
        ),
    ],
)
def test_a_correction_beyond_the_limits_of_its_cell_is_refused(
    desk: Desk, limits: str, scale: float, phrase: str
) -> None:
    values = ", ".join(f"{scale * 1e-5:g}" for _ in range(6))
    axial = f"compliance: {{axial: [{values}]}}"
    desk.write("soft.yaml", f"robot: {{model: ur10e}}\n{axial}\n{limits}\n")
    desk.write("log.csv", csv(target_q=poses(3), payload=np.full(3, 5.0)))
    line = desk.refuses("compensate", "@log.csv", "--cell", "@soft.yaml", "--out", "@o.csv")
    assert phrase in line
    assert not (desk.folder / "o.csv").exists()


def test_near_a_singular_pose_a_large_joint_offset_is_reported(desk: Desk) -> None:
    q = np.vstack([poses(2), [[0.3, -1.2, 1.4, -0.9, 0.002, 0.4]]])  # the wrist is almost straight
    desk.write("log.csv", csv(target_q=q, payload=np.full(3, 12.0)))
    ran = desk.run("compensate", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv")
    assert ran.code == 0
    assert "1 row(s) near a singular pose need more than limits.joint_offset (0.05 rad)" in ran.err
    assert "row 4 needs most" in ran.err


# -- what a user can get wrong ------------------------------------------------------------------

TRACKER = ",".join(f"measured_position_{i}" for i in range(3))
Q1 = f"{TRACKER}," + ",".join(f"actual_q_{i}" for i in range(6))
ROW = ",".join(["0.1"] * 9)
BAD_Q2 = "0,0,0,0.1,0.1,{},0.1,0.1,0.1"


@pytest.mark.parametrize(
    ("log", "given"),
    [
        ("", ["log.csv", "empty"]),
        (f"{Q1}\n", ["log.csv", "no data rows"]),
        ("a,b\n1,2\n", ["log.csv", "columns"]),
        ("payload\n1\n", ["log.csv", "actual_q", "target_q"]),
        (f"{Q1.replace(',actual_q_3', '')}\n0,0,0,0,0,0,0,0\n", ["actual_q_3", "not found"]),
        (f"{Q1},actual_q_6\n{ROW},0\n", ["actual_q_6", "6-joint arm"]),
        (f"{Q1}\n{ROW}\n{ROW},7\n", ["row 3", "10 cells", "expected 9"]),
        (f"{Q1}\n{ROW}\n{BAD_Q2.format('nan')}\n", ["row 3", "actual_q_2", "found nothing"]),
        (f"{Q1}\n{ROW}\n{BAD_Q2.format('x')}\n", ["row 3", "actual_q_2", "'x'"]),
        (f"{Q1}\n{BAD_Q2.format('inf')}\n", ["row 2", "actual_q_2", "inf"]),
        (f"{Q1}\n{ROW}\n1e300,{ROW[4:]}\n", ["row 3", "measured_position_0", "1e+300"]),
        (f"{Q1},payload\n{ROW},-1\n", ["row 2", "payload", "-1"]),
        (f"{Q1},payload\n{ROW},1\n{ROW},400\n", ["row 3", "400 kg", "out of range", "12.5 kg"]),
        (f"{Q1},payload\n{ROW},nan\n", ["row 2", "payload", "found nothing"]),
        (f"{Q1},payload_cog_0\n{ROW},0\n", ["payload_cog_1", "not found"]),
    ],
)
@pytest.mark.parametrize("command", ["predict", "compensate", "fit"])
def test_an_unusable_log_is_refused_in_one_line(
    desk: Desk, command: str, log: str, given: list[str]
) -> None:
    desk.write("log.csv", log)
    out = "out.yaml" if command == "fit" else "out.csv"
    line = desk.refuses(command, "@log.csv", "--cell", "@cell.yaml", "--out", f"@{out}")
    for word in given:
        assert word in line
    assert not (desk.folder / out).exists()


@pytest.mark.parametrize("command", ["predict", "compensate", "fit"])
def test_unusable_paths_are_refused_in_one_line(desk: Desk, command: str) -> None:
    desk.write("log.csv", f"{Q1}\n{ROW}\n")
    os.mkfifo(desk.folder / "pipe")  # as /dev/null is: root could rename a file over it
    out = "@o.yaml" if command == "fit" else "@o.csv"
    for given, reported in (
        (("@none.csv", "--cell", "@cell.yaml", "--out", out), "none.csv: file not found"),
        (("@log.csv", "--cell", "@none.yaml", "--out", out), "none.yaml: file not found"),
        (("@pipe", "--cell", "@cell.yaml", "--out", out), "pipe: found a device or pipe"),
        (("@log.csv", "--cell", "@cell.yaml", "--out", "@none/o.csv"), "found no folder"),
        (("@log.csv", "--cell", "@cell.yaml", "--out", "@log.csv"), "output to be the input"),
        (("@log.csv", "--cell", "@cell.yaml", "--out", "@cell.yaml"), "output to be the input"),
        (("@log.csv", "--cell", "@cell.yaml", "--out", "@"), "found a folder"),
        (("@log.csv", "--cell", "@cell.yaml", "--out", "@pipe"), "found a device or pipe"),
    ):
        assert reported in desk.refuses(command, *given)
    assert (desk.folder / "pipe").is_fifo()


@pytest.mark.parametrize(
    "given",
    [
        ("predict", f"@{'x' * 300}.csv", "--cell", "@cell.yaml", "--out", "@p.csv"),
        ("fit", "@log.csv", "--cell", "@cell.yaml", "--out", f"@{'x' * 300}.yaml"),
        ("check", "@cell.yaml", "--log", f"@{'x' * 300}.csv"),
        ("predict", "@log.csv/log.csv", "--cell", "@cell.yaml", "--out", "@p.csv"),
        ("status", f"@{'x' * 300}.yaml"),
    ],
)
def test_a_path_that_the_system_refuses_is_named_in_one_line(
    desk: Desk, given: tuple[str, ...]
) -> None:
    desk.write("log.csv", csv(actual_q=poses(3)))
    line = desk.refuses(*given)
    assert next(word for word in given if "xxx" in word or "/" in word)[1:] in line
    assert "details" not in line


def test_what_a_block_cannot_read_is_not_told_of_its_output(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"other\.csv"), replacing_bytes(tmp_path / "o.csv"):
        (tmp_path / "other.csv").read_bytes()
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_key_of_a_cell_is_reported_by_the_real_command(desk: Desk) -> None:
    desk.write("cell.yaml", CELL + "payloda: {mass: 5}\n")
    desk.write("log.csv", f"{Q1}\n{ROW}\n")
    command = [sys.executable, "-m", "gapbridge", "predict", "log.csv", "--cell", "cell.yaml"]
    ran = subprocess.run(
        [*command, "--out", "o.csv"], capture_output=True, text=True, check=False, cwd=desk.folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
    )  # fmt: skip
    assert ran.returncode == 2
    assert ran.stderr == (
        "error: cell.yaml, line 4: payloda: found an unknown key 'payloda', expected one that is "
        "known; did you mean 'payload'?\n"
    )


def test_an_unforeseen_failure_is_one_line_and_a_file(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr("gapbridge.bridge.cli.log.predict.open_cell", broken)
    monkeypatch.setattr(sys, "argv", ["gapbridge", os.fsdecode(b"b\xff.csv")])
    ran = desk.run("predict", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv")
    assert ran.code == 1
    assert ran.err.startswith("error: ZeroDivisionError: by nothing (details: ")
    details = Path(ran.err.rsplit(" ", 1)[1].rstrip(")\n"))
    assert "Traceback" in details.read_text()
    assert r"gapbridge b\udcff.csv" in details.read_text()
    details.unlink()
    monkeypatch.setattr(tempfile, "tempdir", str(desk.folder / "none"))
    ran = desk.run("predict", "@log.csv", "--cell", "@cell.yaml", "--out", "@o.csv")
    assert (ran.code, ran.err.count("\n")) == (1, 1)
    assert ran.err.startswith("error: ZeroDivisionError: by nothing (no folder for details")


# -- fit ----------------------------------------------------------------------------------------


def test_fit_finds_the_compliance_and_writes_a_cell_that_predicts(desk: Desk) -> None:
    real = load_cell(desk.folder / "cell.yaml").model
    desk.write("log.csv", measured_log(real, 60))
    ran = desk.run("fit", "@log.csv", "--cell", "@rigid.yaml", "--out", "@new.yaml")
    assert (ran.code, ran.err) == (0, "")
    assert "joint flexibility" in ran.out
    found = load_cell(desk.folder / "new.yaml").model
    q = poses(20, seed=9)
    gap = found.predict(q).position - real.predict(q).position
    before = real.without_terms().predict(q).position - real.predict(q).position
    assert np.abs(gap).max() < 5e-5 < np.abs(before).max()


def test_fit_declines_with_the_reason_where_nothing_bends_the_arm(desk: Desk) -> None:
    desk.write("dh.yaml", "robot: {dh: [{a: 0.5, alpha: 0, d: 0}, {a: 0.4, alpha: 0, d: 0}]}\n")
    q = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    position = load_cell(desk.folder / "dh.yaml").model.predict(q).position
    desk.write("log.csv", csv(actual_q=q, measured_position=position))
    ran = desk.run("fit", "@log.csv", "--cell", "@dh.yaml", "--out", "@new.yaml")
    assert ran.code == 2
    warning, line = ran.err.splitlines()
    assert "without masses" in warning
    assert "log.csv" in line
    assert "payload" in line
    assert not (desk.folder / "new.yaml").exists()


# -- explain and simulate -----------------------------------------------------------------------


@pytest.mark.parametrize("name", CATALOGUE)
def test_every_effect_is_explained_with_its_parameters(desk: Desk, name: str) -> None:
    ran = desk.run("explain", name)
    assert ran.code == 0
    assert ran.out.startswith(name)
    assert "parameters in a cell file:" in ran.out


def test_explain_lists_the_catalogue_and_names_the_nearest(desk: Desk) -> None:
    assert all(name in desk.run("explain").out for name in CATALOGUE)
    assert "'backlash'" in desk.refuses("explain", "backlsh")


@pytest.mark.realtime(limit=0.5)
def test_simulate_serves_until_it_is_asked_to_stop(desk: Desk) -> None:
    host = own_host()
    desk.write("cell.yaml", SOFT + f"simulation: {{host: {host}, seed: 3}}\n")
    command = [sys.executable, "-m", "gapbridge", "simulate", str(desk.folder / "cell.yaml")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        reported = [server.stdout.readline() for _ in range(2)]
        with socket.create_connection((host, 30100), timeout=PATIENCE) as bench:
            bench.sendall(b"measure\n")
            assert len(bench.recv(4096).split(b",")) == 7
        start = time.monotonic()
        server.send_signal(signal.SIGTERM)
        assert server.wait(PATIENCE) == 0
    assert time.monotonic() - start < 3
    assert host in reported[0]
    assert reported[1] == f"ready {host}\n"


def test_simulate_is_never_served_to_others(desk: Desk) -> None:
    desk.write("cell.yaml", CELL + "link: {host: 192.168.0.3}\n")
    line = desk.refuses("simulate", "@cell.yaml")
    assert "simulation.host: found nothing, and '192.168.0.3' at link.host, expected a loop" in line
    line = desk.refuses("simulate", "@cell.yaml", "--host", "8.8.8.8")
    assert line.startswith("error: --host: found '8.8.8.8', expected a loopback address")
