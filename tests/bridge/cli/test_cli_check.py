"""``gapbridge check`` and ``init``, with the simulated controller where one is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import gapbridge, refused
from daemon_cell import plant
from simulated_controller import SimulatedController

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.verification_mark import write_mark
from gapbridge.core.arm import builtin_arm
from gapbridge.core.model import Model
from gapbridge.core.plausibility import flange_in_first
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.controller_facts import ControllerFacts, differences
from gapbridge.drivers.simulated.ur.settings import announced_rows
from gapbridge.drivers.ur_rtde.enquiry import enquire

DELTAS = {
    "delta_theta": [1e-7, -1e-4, 2e-4, 1e-4, 0.0, 0.0],
    "delta_a": [1e-5, 3e-4, -2e-4, 0.0, 0.0, 0.0],
    "delta_d": [1e-4, 439.14, -439.1399, 1e-4, 0.0, 0.0],  # meet far out and cancel
    "delta_alpha": [-3e-4, 1e-6, -1e-6, 2e-4, 1e-4, 0.0],
}


@pytest.fixture(scope="module")
def host() -> Iterator[str]:
    settings = replace(plant(), calibrated=announced_rows("ur10e", DELTAS))
    with SimulatedController(settings) as running:
        yield running.host


def cell(folder: Path, host: str, tcp: str = "0.18", more: str = "") -> Path:
    path = folder / "cell.yaml"
    path.write_text(
        f"robot: {{model: ur10e}}\ntool: {{tcp: {{xyz: [0, 0, {tcp}]}}}}\n"
        f"payload: {{mass: 5, cog: [0, 0, 0.06]}}\nlink: {{host: {host}}}\n{more}",
        encoding="utf-8",
    )
    return path


def read_slowly(path: Path) -> None:
    """Lower the rate of a cell that is written: on a busy machine no two states are 2 ms apart."""
    text = path.read_text(encoding="utf-8")
    assert "rate: 500" in text
    path.write_text(text.replace("rate: 500", "rate: 50"), encoding="utf-8")


def cell_of(folder: Path, lines: str) -> Path:
    path = folder / "cell.yaml"
    path.write_text(f"robot: {{model: ur10e}}\n{lines}\n")
    return path


def test_a_cell_that_is_wrong_ends_with_two_and_every_line(tmp_path: Path) -> None:
    path = cell_of(tmp_path, "gravity: [0, 0, -1]\nreference_temperature: 298")
    answer = gapbridge("check", path)
    assert answer.code == 2
    lines = answer.err.splitlines()
    assert [line.split(": ")[2] for line in lines] == ["gravity", "reference_temperature"]
    assert all(line.startswith(f"error: {path}, line ") for line in lines)


def test_a_cell_whose_verification_failed_is_not_fit(tmp_path: Path) -> None:
    path = cell_of(tmp_path, "")
    mark = write_mark(path, "the zero of joint 5 moved by 10 mrad", tmp_path)
    assert refused("check", path).startswith(f"error: {mark}: the zero of joint 5 moved by 10 mrad")
    mark.unlink()
    assert gapbridge("check", path).code == 0


def test_effects_that_leave_less_than_no_load_are_named_with_key_and_row(tmp_path: Path) -> None:
    path = cell_of(
        tmp_path, "effects: [{effect: payload, parameters: {value: -5}}]\npayload: {mass: 2}"
    )
    found = "found 2 kg and -5 kg of the effects"
    assert refused("check", path).startswith(f"error: {path}, line 3: payload.mass: {found}")
    columns, log = ",".join(f"actual_q_{i}" for i in range(6)), tmp_path / "log.csv"
    log.write_text(f"{columns}\n0,-1,1,0,0,0\n")
    predict = ("predict", log, "--cell", path, "--out", tmp_path / "out.csv")
    assert refused(*predict).startswith(f"error: {path}, line 3: payload.mass: {found}")
    log.write_text(f"payload,{columns}\n4.8,0,-1,1,0,0,0\n2,0,-1,1,0,0,0\n")
    assert f"{log}: row 3, column payload: {found}" in refused(*predict)
    log.write_text(f"payload,{columns}\n4.8,0,-1,1,0,0,0\n")  # an estimate may be below zero
    assert gapbridge(*predict).code == 0


def test_a_trajectory_that_cannot_be_run_is_named(tmp_path: Path) -> None:
    path = cell(tmp_path, "127.0.0.1", more="setpoints: {source: trajectory, file: way.csv}\n")
    err = refused("check", path)
    assert err.startswith(
        f"error: {path}, line 5: setpoints.file: {tmp_path}/way.csv: file not found"
    )
    (tmp_path / "way.csv").write_text("timestamp,target_q_0\n0,0\n1,0\n")
    assert "target_q" in refused("check", path)
    joints = ",".join(f"target_q_{i}" for i in range(6))
    (tmp_path / "way.csv").write_text(f"timestamp,{joints}\n0{',0' * 6}\n1{',0' * 6}\n")
    assert gapbridge("check", path).code == 0


def test_a_fit_cell_ends_with_zero_and_says_so(tmp_path: Path) -> None:
    path = cell_of(tmp_path, "metrology: {sigma: 0.005}")
    answer = gapbridge("check", path)
    assert answer.code == 0
    assert answer.out == f"{path}: fit to be used, 1 warning\n"
    assert answer.err.startswith(f"warning: {path}, line 2: metrology.sigma")


@pytest.mark.parametrize(
    ("lines", "place"),
    [
        ("payload: {mass: 5000}", "line 2: payload.mass: found 5000 kg"),
        ("effects:\n  - {effect: backlash, parameters: {value: 1e-4}}",
         "line 3: effects entry 1.joint: found none"),
        ("effects:\n  - {effect: backlash, joint: 9, parameters: {value: 1}}",
         "line 3: effects entry 1.joint: found 9"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_arm_is_named_with_its_line(
    tmp_path: Path, lines: str, place: str
) -> None:
    path = cell_of(tmp_path, lines)
    assert f"error: {path}, {place}" in gapbridge("check", path).err
    assert f"{path}, {place}" in refused("simulate", path)


Q = np.random.default_rng(3).uniform(-2.0, 2.0, (30, 6))
CRAIG = """robot:
  dh:  # of a UR10e, in Craig's convention
    - {a: 0, d: 0.1807, alpha: 0, offset: 0}
    - {a: 0, d: 0, alpha: 1.570796327, offset: 0}
    - {a: -0.6127, d: 0, alpha: 0, offset: 0}
    - {a: -0.57155, d: 0.17415, alpha: 0, offset: 0}
    - {a: 0, d: 0.11985, alpha: 1.570796327, offset: 0}
    - {a: 0, d: 0.11655, alpha: -1.570796327, offset: 0}
"""


def measured_log(folder: Path, order: tuple[int, ...] = (0, 1, 2, 3, 4, 5)) -> Path:
    """Write poses of a UR10e as an instrument in base measured them, joints in an ``order``."""
    position = Model(arm=builtin_arm("ur10e")).rigid_pose(Q).position
    names = [f"actual_q_{i}" for i in range(6)] + [f"measured_position_{i}" for i in range(3)]
    path = folder / "log.csv"
    np.savetxt(path, np.hstack([Q[:, order], position]), delimiter=",", header=",".join(names),
               comments="")  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("robot", "order", "phrase"),
    [
        (CRAIG, (0, 1, 2, 3, 4, 5), "robot.dh looks like modified DH rows (Craig)"),
        ("robot: {model: ur10e}\n", (2, 1, 0, 3, 4, 5), "joints 1 and 3 look swapped (a UR's"),
        ("robot: {model: ur10e}\n", (0, 1, 2, 5, 3, 4), "the joints look out of order: joint 4 is"),
        ("robot: {model: ur3e}\n", (0, 1, 2, 3, 4, 5), "they look like those of a ur10e"),
        ("robot: {model: ur3e}\n", (1, 0, 2, 4, 3, 5), "is it the right arm, tool and order"),
    ],
)  # fmt: skip
def test_another_arm_than_was_measured_is_named_by_its_mistake(
    tmp_path: Path, robot: str, order: tuple[int, ...], phrase: str
) -> None:
    path, log = tmp_path / "cell.yaml", measured_log(tmp_path, order)
    path.write_text(robot)
    answer = gapbridge("check", path, "--log", log)
    assert answer.code == 2
    (line,) = [line for line in answer.err.splitlines() if line.startswith("error")]
    assert phrase in line


def test_the_arm_that_was_measured_fits_its_log(tmp_path: Path) -> None:
    path, log = tmp_path / "cell.yaml", measured_log(tmp_path)
    path.write_text("robot: {model: ur10e}\n")
    answer = gapbridge("check", path, "--log", log)
    assert (answer.code, answer.out) == (0, f"{path}: fit to be used with {log}\n")
    log.write_text(
        "actual_q_0,actual_q_1,actual_q_2,actual_q_3,actual_q_4,actual_q_5\n0,0,0,0,0,0\n"
    )
    assert "columns measured_position_0..2: not found" in refused("check", path, "--log", log)


@pytest.mark.parametrize(
    ("before", "after", "phrase"),
    [
        ("actual_q_", "q_", "columns: found no actual_q_0..5 or target_q_0..5"),
        (
            "measured_position_0",
            "measured_position[0]",
            "expected 3 columns measured_position_0..2",
        ),
        ("measured", "mesured", "found mesured_position_0; did you mean measured_position_0?"),
        ("\n", ",payload\n", "row 2, column payload: found -1, expected 0 or more kg"),
    ],
)
def test_a_log_that_no_command_can_use_does_not_pass(
    tmp_path: Path, before: str, after: str, phrase: str
) -> None:
    path, log = tmp_path / "cell.yaml", measured_log(tmp_path)
    path.write_text("robot: {model: ur10e}\n")
    header, _, rows = log.read_text().partition("\n")
    if "payload" in after:
        rows = rows.replace("\n", ",-1\n")
    log.write_text(f"{header}\n".replace(before, after) + rows)
    assert phrase in refused("check", path, "--log", log)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "phrase"),
    [((2, 1, 0, 3, 4, 5), "joints 1 and 3 look swapped (a UR's"),
     ((0, 1, 2, 4, 3, 5), "joints 4 and 5 look swapped")],
)  # fmt: skip
def test_fit_and_diagnose_of_another_arm_warn_with_the_mistake(
    tmp_path: Path, order: tuple[int, ...], phrase: str
) -> None:
    path, log = tmp_path / "cell.yaml", measured_log(tmp_path, order)
    path.write_text("robot: {model: ur10e}\n")
    new = tmp_path / "new.yaml"
    for command in (("fit", "--out", new), ("diagnose",), ("diagnose", "--apply", new)):
        answer = gapbridge(command[0], log, "--cell", path, *command[1:])
        assert answer.code == 0  # a cell is always written
        (line,) = answer.err.splitlines()
        assert line.startswith(f"warning: {log}: the measured positions do not follow the arm: ")
        assert phrase in line
        assert phrase not in answer.out
    assert line.endswith("; no cause is written into the cell")
    assert load_cell(new).model.terms == ()


def test_every_command_refuses_it_in_one_line(tmp_path: Path) -> None:
    path = cell_of(tmp_path, "tool: {tcp: {xyz: [0, 0, 180]}}\nlink: {}")
    (tmp_path / "log.csv").write_text("actual_q_0\n0\n")
    for command in (("predict", tmp_path / "log.csv", "--out", tmp_path / "o.csv", "--cell"),
                    ("run",), ("simulate",)):  # fmt: skip
        assert f"{path}, line 2: tool.tcp.xyz: found 180 m" in refused(*command, path)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("link: {driver: can, profile: openarm}", "line 2: link.profile: found 7 joints in"),
        ("link: {host: 127.0.0.2}\nsetpoints: {source: trajectory}",
         "line 3: setpoints.file: found nothing"),
        ("link: {driver: replay, file: cell.yaml}",
         "line 2: link.file: {folder}/cell.yaml: found no MCAP file"),
        ("link: {driver: modbus, profile: none.yaml}",
         "line 2: link.profile: {folder}/none.yaml: file not found, expected a profile"),
        ("calibration: {joint_range: {lower: [0], upper: [1]}}",
         "line 2: calibration.joint_range.lower: found 1 values, expected 6"),
        ("calibration: {joint_range: {lower: [0, 2, 0, 0, 0, 0], upper: [1, 1, 1, 1, 1, 1]}}",
         "line 2: calibration.joint_range.lower entry 2: found 2, expected less than upper, 1"),
        ("calibration: {joint_range: {lower: [8, 0, 0, 0, 0, 0], upper: [9, 1, 1, 1, 1, 1]}}",
         "line 2: calibration.joint_range: joint 1: found limits 8 to 6.283 rad"),
        ("calibration:\n  effects: [backlash, foo]",
         "line 3: calibration.effects entry 2: found 'foo', expected one of the catalogue"),
        ("calibration: {effects: [latency]}", "line 2: calibration.effects entry 1: found 'lat"),
        ("provenance: {parameters: [foo_9], covariance: [[1]]}",
         "line 2: provenance.parameters entry 1: found 'foo_9', expected a parameter of an"),
        ("provenance: {parameters: [backlash_9], covariance: [[1]]}",
         "line 2: provenance.parameters entry 1: found 'backlash_9', expected a parameter of this"),
    ],
)  # fmt: skip
def test_what_only_a_run_would_refuse_is_named_with_its_line(
    tmp_path: Path, lines: str, message: str
) -> None:
    path = cell_of(tmp_path, lines)
    assert f"error: {path}, {message.replace('{folder}', str(tmp_path))}" in refused("check", path)


@pytest.mark.parametrize(
    "lines",
    [
        "link: {driver: replay, file: cell.yaml}",
        "link: {host: 127.0.0.2}\nsetpoints: {source: trajectory, file: cell.yaml}",
    ],
)
def test_a_run_that_cannot_begin_leaves_no_recording(tmp_path: Path, lines: str) -> None:
    path = cell_of(tmp_path, lines + "\nrecording: {folder: recordings}")
    assert f": {tmp_path}/cell.yaml: " in refused("run", path)
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_cell_cannot_be_armed(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("timestamp\n0\n")
    assert "log.csv, line 1: found no keys, expected a cell" in refused("arm", tmp_path / "log.csv")


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [(0, 0, "line 1: robot: joint 1: found limits 0 to 0 rad, expected lower below upper")],
)
def test_a_joint_without_room_is_refused_where_a_run_would_fail(
    tmp_path: Path, lower: float, upper: float, message: str
) -> None:
    (tmp_path / "arm.urdf").write_text(
        '<robot name="r"><link name="a"/><link name="b"/><link name="c"/>'
        '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        f'<limit lower="{lower}" upper="{upper}" velocity="2" effort="9"/></joint>'
        '<joint name="f" type="fixed"><parent link="b"/><child link="c"/><origin xyz="0 0 1"/>'
        "</joint></robot>"
    )
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {urdf: arm.urdf}\n")
    assert gapbridge("check", path).code == 0
    path.write_text("robot: {urdf: arm.urdf}\nlink: {driver: replay, file: cell.yaml}\n")
    assert f"error: {path}, {message}" in gapbridge("check", path).err


TRAJECTORY = "link: {host: 127.0.0.2}\nsetpoints: {source: trajectory, file: t.csv}"


@pytest.mark.parametrize(
    ("joint_2", "code", "message"),
    [
        ((0.0, 0.1, 0.2), 0, ""),
        ((0.0, 7.0, 7.1), 2, "row 3, column target_q_1: found 7.0000 rad, expected -6.2832 to"),
        ((0.0, -90.0, 0.0), 2, "to 6.2832 (it looks like degrees)"),
        ((0.0, 0.1, 0.4), 0, "row 4, column target_q_1: found 3 rad/s, expected at most 2.09: "
         "`run` lags behind it"),
        ((0.0, 0.5, 0.5), 2, "row 3, column target_q_1: found 5 rad/s, expected at most 2.09: "
         "`run` refuses such a jump"),
    ],
)  # fmt: skip
def test_a_trajectory_beyond_the_limits_is_named_with_row_and_joint(
    tmp_path: Path, joint_2: tuple[float, ...], code: int, message: str
) -> None:
    path = cell_of(tmp_path, TRAJECTORY)
    rows = [f"{0.1 * i},0,{q},0,0,0,0" for i, q in enumerate(joint_2)]
    header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
    (tmp_path / "t.csv").write_text("\n".join([header, *rows]) + "\n")
    answer = gapbridge("check", path)
    assert answer.code == code
    assert message in answer.err
    if message:
        kind = "error" if code else "warning"
        assert f"{kind}: {path}, line 3: setpoints.file: {tmp_path}/t.csv: row " in answer.err


def test_a_trajectory_of_any_length_is_checked(tmp_path: Path) -> None:
    path = cell_of(tmp_path, TRAJECTORY)
    rows = [
        "0,0,0,0,0,0,0",
        "0.0005,0.003,0,0,0,0,0",
        "1e300,0,0,0,0,0,0",
    ]  # 6 rad/s, a quarter cycle
    header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
    (tmp_path / "t.csv").write_text("\n".join([header, *rows]) + "\n")
    answer = gapbridge("check", path)
    assert (answer.code, answer.err) == (0, "")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [("none.pem", None, "link.authority: {folder}/none.pem: found no file, expected PEM"),
     ("ca.pem", "no PEM", "link: authority, certificate, key: ")],
)  # fmt: skip
def test_files_of_an_encrypted_link_are_found_unusable(
    name: str, text: str | None, message: str, tmp_path: Path
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    link = f"{{driver: modbus, profile: ur, host: 127.0.0.1, transport: tls, authority: {name}}}"
    answer = gapbridge("check", cell_of(tmp_path, f"link: {link}"))
    assert answer.code == 2
    assert message.format(folder=tmp_path) in answer.err
    assert "line 2" in answer.err


def test_a_recording_that_is_none_is_refused_in_one_line(tmp_path: Path) -> None:
    path, log = tmp_path / "cell.yaml", tmp_path / "log.mcap"
    path.write_text("robot: {model: ur10e}\n")
    log.write_bytes(b"hello")
    assert f"{log}: found no MCAP file" in refused("check", path, "--log", log)


def test_the_controller_reports_what_it_is(host: str) -> None:
    facts = enquire(host, SYSTEM)
    assert (facts.n, facts.model, facts.version, facts.rate) == (6, "ur10e", "5.15.0", 500.0)
    assert facts.payload == 5.0
    assert facts.payload_cog is not None
    assert facts.tcp is not None
    np.testing.assert_allclose(facts.payload_cog, [0, 0, 0.06])
    np.testing.assert_allclose(facts.tcp[:3, 3], [0, 0, 0.18])
    np.testing.assert_allclose(facts.gravity, [0, 0, -9.80665])
    for key, values in DELTAS.items():
        np.testing.assert_allclose(facts.calibration[key], values, atol=1e-12)
    arm = builtin_arm("ur10e")
    assert facts.lower is not None
    assert facts.velocity is not None
    np.testing.assert_allclose(facts.lower, arm.limits.lower)
    np.testing.assert_allclose(facts.velocity, arm.limits.velocity)


def test_live_reports_where_the_controller_differs(host: str, tmp_path: Path) -> None:
    answer = gapbridge("check", cell(tmp_path, host, "0.25"), "--live")
    assert answer.code == 2
    assert "line 2: tool.tcp: found a TCP 70 mm" in answer.err
    assert "line 1: robot.calibration: found geometry up to" in answer.err


@pytest.mark.parametrize(
    ("rate", "code", "text"),
    [
        (700, 0, "warning: {0}, line 4: link.rate: found 700 Hz, expected at most 500 Hz"),
        (900, 2, "error: {0}, line 4: link.rate: found 900 Hz, expected at most 500 Hz: the contr"),
    ],
)
def test_a_rate_that_the_controller_has_not_is_refused_as_arming_does(
    host: str, tmp_path: Path, rate: int, code: int, text: str
) -> None:
    path = cell(tmp_path, host)
    path.write_text(path.read_text().replace(f"host: {host}", f"host: {host}, rate: {rate}"))
    answer = gapbridge("check", path, "--live")
    (line,) = (line for line in answer.err.splitlines() if "link.rate" in line)
    assert (answer.code, line.startswith(text.format(path))) == (code, True), line


def test_live_shows_the_values_of_both_side_by_side(host: str, tmp_path: Path) -> None:
    path = cell(tmp_path, host, "0.25")
    path.write_text(path.read_text().replace("mass: 5", "mass: 2"))
    shown = {line[:13].strip(): line[13:].split("  ") for line in
             gapbridge("check", path, "--live").out.splitlines()}  # fmt: skip
    found = {name: (values[0], values[-1].strip()) for name, values in shown.items()}
    assert found["quantity"] == ("cell", "controller")
    assert found["TCP xyz"] == ("[0, 0, 0.25] m", "[0, 0, 0.18] m")
    assert found["payload"] == ("2 kg", "5 kg")
    assert found["calibration"][0] == "none"
    assert found["calibration"][1].startswith("flange within 0.")
    assert found["rate"][0] == "500 Hz"
    assert found["rate"][1].startswith("500 Hz, measured ")


def test_live_passes_the_controllers_own_cell(host: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    assert gapbridge("init", host, "--out", path).code == 0
    read_slowly(path)
    answer = gapbridge("check", path, "--live")
    assert answer.code == 0, answer.err
    found = load_cell(path)
    assert found.warnings == ()
    assert found.model.payload_mass == 5.0
    np.testing.assert_allclose(found.model.tool_in_flange[:3, 3], [0, 0, 0.18])
    q = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    np.testing.assert_allclose(
        flange_in_first(found.arm, q), flange_in_first(builtin_arm("ur10e", DELTAS), q), atol=1e-9
    )
    assert "# " in path.read_text()


def test_an_arm_that_hangs_is_no_arm_that_stands(tmp_path: Path) -> None:
    """UR's gravity is what holds the arm up: set_gravity([0, 0, 9.82]) where it stands upright."""
    path = tmp_path / "hanging.yaml"
    with SimulatedController(plant(gravity=(0.0, 0.0, 9.80665))) as running:
        assert gapbridge("init", running.host, "--out", path).code == 0
        read_slowly(path)
        np.testing.assert_allclose(load_cell(path).model.gravity, [0, 0, 9.80665])
        assert gapbridge("check", path, "--live").code == 0
        standing = gapbridge("check", cell(tmp_path, running.host), "--live")
    assert standing.code == 2
    assert "gravity: found [0, 0, -9.80665], expected [0, 0, 9.807]" in standing.err


def test_gravity_across_the_base_of_a_urdf_only_warns() -> None:
    """Its horizontal axes are the author's choice: half a turn apart in UR's own models."""
    model = Model(arm=replace(builtin_arm("ur10e"), joint_names=tuple("abcdef")))
    for gravity, sure in (([0.0, 6.9, -6.9], True), ([1.0, 0.0, -9.75], False)):
        (found,) = differences(ControllerFacts(n=6, gravity=np.array(gravity)), model)
        assert (found.keys, found.sure) == (("gravity",), sure)


def test_init_overwrites_nothing_and_needs_a_controller(host: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("kept")
    assert "already there" in refused("init", host, "--out", path)
    assert path.read_text() == "kept"
    answer = gapbridge("init", "127.9.9.9", "--out", tmp_path / "new.yaml")
    assert answer.code == 1
    assert "127.9.9.9" in answer.err
    assert not (tmp_path / "new.yaml").exists()


def test_an_arm_that_no_ur_can_be_is_refused_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(CRAIG.rsplit("    -", 1)[0] + "link: {host: 127.0.0.2}\n")
    assert (
        f"error: {path}, line 8: link: found driver ur_rtde with an arm of 5 joints, expected 6"
        in gapbridge("check", path).err
    )


def test_a_controller_that_is_not_there_is_named_with_its_port(tmp_path: Path) -> None:
    answer = gapbridge("check", cell(tmp_path, "127.9.9.9", "0.18"), "--live")
    assert answer.code == 1
    (line,) = answer.err.splitlines()
    assert line.startswith("error: could not connect to 127.9.9.9, port 30004")


def test_init_without_a_profile_names_those_that_are_shipped(tmp_path: Path) -> None:
    line = refused("init", "127.9.9.9", "--driver", "modbus", "--out", tmp_path / "new.yaml")
    assert "--profile" in line
    assert "doosan, elite_ec, igus" in line


def test_a_cell_with_another_tcp_does_not_arm(host: str, tmp_path: Path) -> None:
    more = f"compliance: {{axial: {[1e-5] * 6}}}\nrecording: {{folder: out}}\n"
    path = cell(tmp_path, host, "0.25", more)
    answer = gapbridge("run", path, "--arm", "--duration", "3")
    assert answer.code != 0
    assert "tool.tcp: found a TCP 70 mm" in answer.out + answer.err
