"""Impossible values of a cell are errors with their line, unusual ones are warnings."""

from __future__ import annotations

from pathlib import Path

import pytest

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.cell import cell_errors
from gapbridge.core.arm import builtin_rows
from gapbridge.core.errors import CellError

ARM = "robot: {model: ur10e}\n"
URDF = """<robot name="r"><link name="base"/><transmission><joint name="j2"/></transmission>
<link name="one"><inertial><mass value="{mass}"/></inertial></link><link name="two">
<inertial><mass value="3"/></inertial></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>
<joint name="j2" type="revolute"><parent link="one"/><child link="two"/>
<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 1 0"/>
<limit lower="{lower}" upper="2" velocity="{speed}" effort="9"/>{more}</joint>
<link name="flange"/><joint name="f" type="fixed"><parent link="two"/><child link="flange"/>
<origin xyz="0 0 0.4"/></joint></robot>"""


def session(text: str) -> str:
    return f"{ARM}calibration: {{{text}}}"


def written(folder: Path, text: str) -> Path:
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def dh(**changed: float) -> str:
    rows = [dict(row) for row in builtin_rows("ur10e")["dh"]]
    for key, factor in changed.items():
        for row in rows:
            row[key] *= factor
    return f"robot: {{dh: {rows}}}\n".replace("'", "")


@pytest.mark.parametrize(
    ("text", "line", "key", "found", "expected"),
    [
        (ARM + "tool: {tcp: {xyz: [0, 0, 180]}}", 2, "tool.tcp.xyz", "180 m", "mm"),
        (ARM + "tool: {tcp: {rpy: [0, 0, 90]}}", 2, "tool.tcp.rpy", "90", "degrees"),
        (ARM + "payload: {mass: 5, cog: [0, 0, 60]}", 2, "payload.cog", "60 m", "mm"),
        (ARM + "gravity: [0, 0, -1]", 2, "gravity", "1", "9.80665"),
        (ARM + "gravity: [0, 0, -9810]", 2, "gravity", "9810", "9.80665"),
        (ARM + "\nreference_temperature: 298", 3, "reference_temperature", "298", "kelvin"),
        (ARM + "metrology: {sigma: 0.02}", 2, "metrology.sigma", "0.02", "mm"),
        (ARM + "metrology: {repeatability: 0.05}", 2, "metrology.repeatability", "0.05", "mm"),
        (ARM + "compliance: {axial: [1e5, 0, 0, 0, 0, 0]}", 2, "compliance.axial", "100000", "Nm"),
        (ARM + "simulation: {start_q: [0, -90, 0, 0, 0, 0]}", 2, "start_q", "-90", "degrees"),
        (ARM + "limits: {joint_velocity: 180}", 2, "limits.joint_velocity", "180", "degrees"),
        (ARM + "limits: {joint_margin: 100}", 2, "limits.joint_margin", "100", "less than 3.14"),
        (ARM + "limits: {joint_margin: .inf}", 2, "limits.joint_margin", "inf", "less than 3.14"),
        (ARM + "web: {port: 30390}\nmetrics: {}", 3, "metrics.port", "30390", "that of web.port"),
        (ARM + "simulation: {start_q: [0]}", 2, "simulation.start_q", "1 values", "6"),
        (ARM + "simulation: {start_q: [0, 0, 4, 0, 0, 0]}", 2, "start_q entry 3", "4", "limits"),
        (ARM + "simulation: {zero: [1]}", 2, "simulation.zero", "1 values", "6"),
        (ARM + "simulation: {droop: [1]}", 2, "simulation.droop", "1 values", "6"),
        (ARM + "simulation: {compliance: {axial: [1]}}", 2, "compliance.axial", "1 values", "6"),
        (ARM + "simulation: {host: 8.8.8.8}", 2, "simulation.host", "'8.8.8.8'", "a loopback"),
        (ARM + "simulation: {rtde_port: 9, primary_port: 9}", 2, "simulation.primary_port", "9",
         "another port than that of simulation.rtde_port"),
        (ARM + "simulation: {rtde_port: 30001}", 2, "simulation.rtde_port", "30001",
         "another port than that of simulation.primary_port"),
        (session("accuracy: 0.2"), 2, "calibration.accuracy", "0.2", "mm"),
        (session("floor: 100"), 2, "calibration.floor", "100", "mm"),
        (session("instrument_at: [2000, -100, 0]"), 2, "instrument_at", "2000", "mm"),
        (session("further_places: [[0, -1500, 0]]"), 2, "further_places", "1500", "mm"),
        (session("keep_out: [{lower: [0, 0, 0], upper: [-1, 1, 1]}]"), 2,
         "keep_out entry 1.lower", "[0.0, 0.0, 0.0]", "less than upper"),
        (session("joint_range: {lower: [-90, 0, 0, 0, 0, 0], upper: [1, 1, 1, 1, 1, 1]}"), 2,
         "calibration.joint_range.lower", "90", "degrees"),
        (session("instrument_range: {nearest: 300}"), 2, "instrument_range.nearest", "300", "mm"),
        (session("instrument_range: {farthest: 6000}"), 2, "range.farthest", "6000", "mm"),
        (session("loads: [{mass: 900}]"), 2, "calibration.loads entry 1.mass", "900", "kg"),
        (session("loads: [{mass: 2, cog: [0, 0, 50]}]"), 2, "entry 1.cog", "50 m", "mm"),
        ("robot: {model: ur10e, calibration: {delta_theta: [0, 0, 0, 0, 0, 0],\n"
         "  delta_a: [0, 0.5, 0, 0, 0, 0]}}", 1, "robot.calibration", "500 mm", "few mm"),
        (dh(a=1e3, d=1e3), 1, "robot.dh entry 2.a", "-612.7", "mm"),
        (dh(alpha=57.29578), 1, "robot.dh entry 1.alpha", "90", "degrees"),
        (dh(mass=1e3), 1, "robot.dh", "7369 kg", "grams"),
    ],
)  # fmt: skip
def test_an_impossible_value_is_an_error_with_its_line(
    tmp_path: Path, text: str, line: int, key: str, found: str, expected: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(CellError) as caught:
        load_cell(path)
    reported = str(caught.value)
    assert reported.startswith(f"{path}, line {line}: ")
    assert "\n" not in reported
    output, wanted = reported.split(", expected ")
    assert key in output
    assert found in output.split("found ")[1]
    assert expected in wanted


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        (ARM + "gravity: [0, 0, 0]", "gravity"),
        (ARM + "gravity: [0, 0, -10]", "gravity"),
        (ARM + "metrology: {sigma: 0.005}", "metrology.sigma"),
        (
            ARM + "calibration: {instrument: {kind: typed, unit: mm, sigma: 0.005}}",
            "calibration.instrument.sigma",
        ),
        (session("floor: -50"), "null for none (mm?"),
        (ARM + "reference_temperature: 77", "Fahrenheit"),
        (ARM + "tool: {tcp: {xyz: [0, 0, 1.8]}}", "reach"),
        (ARM + "compliance: {radial: [0.05, 0, 0, 0, 0, 0]}", "rad/Nm"),
        (dh(mass=0.0), "without masses"),
    ],
)
def test_an_unusual_value_is_a_warning(tmp_path: Path, text: str, phrase: str) -> None:
    (warning,) = load_cell(written(tmp_path, text)).warnings
    assert "cell.yaml, line " in warning
    assert phrase in warning


@pytest.mark.parametrize(
    ("changed", "phrase"),
    [
        ({"xyz": "0 0 612.7"}, "line 6: joint 'j2': found origin xyz 612.7"),
        ({"rpy": "0 90 0"}, "line 6: joint 'j2': found origin rpy 90"),
        ({"lower": "-170"}, "line 6: joint 'j2': found limit lower 170"),
        ({"lower": "2.5"}, "line 6: joint 'j2': found limit lower 2.5 and upper 2, expected lower"),
        ({"speed": "100"}, "found limit velocity 100, expected the joint's largest speed in rad/s"),
        ({"more": "<mimic joint='j1'/>"}, "line 6: joint 'j2': found <mimic>"),
        ({"mass": "7369"}, "found 7369 kg of link 1"),
        ({"mass": "4000"}, "m reach, expected kg (grams?)"),
        ({"mass": '4"/><inertia ixx="1e9'}, "found 1e+09 kg m2, inertia of link 1, expected kg m2"),
        ({"xyz": "0 1e300 0"}, "line 6: joint 'j2': found origin xyz 1e+300"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_urdf_in_other_units_is_refused_with_its_line_too(
    tmp_path: Path, changed: dict[str, str], phrase: str
) -> None:
    given = {"xyz": "0 0 0.5", "rpy": "0 0 0", "lower": "-2", "more": "", "mass": "4", "speed": "2"}
    (tmp_path / "arm.urdf").write_text(URDF.format(**(given | changed)), encoding="utf-8")
    path = written(tmp_path, "robot:\n  urdf: arm.urdf\n")
    with pytest.raises(CellError, match=r"cell\.yaml, line 2: robot\.urdf: ") as caught:
        load_cell(path)
    assert phrase in str(caught.value)


def test_a_sane_urdf_passes_and_one_without_a_mass_warns(tmp_path: Path) -> None:
    given = {"xyz": "0 0 0.5", "rpy": "0 0 0", "lower": "-2", "more": "", "mass": "4", "speed": "2"}
    (tmp_path / "arm.urdf").write_text(URDF.format(**given), encoding="utf-8")
    path = written(tmp_path, "robot: {urdf: arm.urdf}\n")
    assert load_cell(path).warnings == ()
    (tmp_path / "arm.urdf").write_text(URDF.format(**(given | {"mass": "0"})), encoding="utf-8")
    assert "no mass of link 1" in load_cell(path).warnings[0]
    heavy = URDF.format(**(given | {"mass": '4"/><inertia ixx="99'}))
    (tmp_path / "arm.urdf").write_text(heavy, encoding="utf-8")
    assert "found 99 kg m2, inertia of link 1" in load_cell(path).warnings[0]


def test_lengths_of_a_calibration_that_cancel_are_right_as_they_stand(tmp_path: Path) -> None:
    calibration = "{delta_d: [0, 439.14, -439.14, 0, 0, 0]}"
    path = written(tmp_path, f"robot: {{model: ur10e, calibration: {calibration}}}\n")
    assert load_cell(path).warnings == ()


def test_all_errors_are_listed(tmp_path: Path) -> None:
    text = ARM + "tool: {tcp: {xyz: [0, 0, 180]}}\ngravity: [0, 0, -1]\n"
    lines = cell_errors(written(tmp_path, text))
    assert [line.split(": ")[1] for line in lines] == ["tool.tcp.xyz", "gravity"]
