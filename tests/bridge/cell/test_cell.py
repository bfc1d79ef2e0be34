"""Reading cell files: their values, and a one-line message for every mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.cell import cell_errors
from gapbridge.core.errors import ArmError, CellError
from gapbridge.core.rotation import rotation_matrix

CONFIG = Path(__file__).parents[3] / "config"
DATA = Path(__file__).parents[4] / "shared" / "data"
ARM = "robot: {model: ur10e}\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def reported(folder: Path, text: str) -> str:
    """The one line that a cell is refused with."""
    with pytest.raises((CellError, ArmError)) as caught:
        load_cell(written(folder, text))
    line = str(caught.value)
    assert "\n" not in line
    assert str(folder / "cell.yaml") in line
    return line


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda p: p.stem)
def test_ready_cells_load_without_a_warning(path: Path) -> None:
    cell = load_cell(path)
    # the maker's URDF of the LWA 4P has no masses, and a user should know
    warned = [line for line in cell.warnings if "without masses" not in line]
    assert warned == []
    assert bool(cell.warnings) == path.stem.startswith("lwa4p")
    assert cell.arm.n == (7 if "seven" in path.stem else 6)


@pytest.mark.parametrize("name", ["barrett_wam_grid", "ipa_ur10_a", "rad_ur3e_rtde"])
def test_cells_of_measured_data_load(name: str) -> None:
    path = DATA / name / "cell.yaml"
    if not path.exists():
        pytest.skip(f"no measured data at {path}")
    assert load_cell(path).arm.n in (6, 7)


def test_every_key_reaches_the_model(tmp_path: Path) -> None:
    cell = load_cell(written(tmp_path, """
robot: {model: ur10e}
tool: {tcp: {xyz: [0.1, 0.2, 0.3], rpy: [0.1, -0.2, 0.3]}}
payload: {mass: 4.5, cog: [0.01, 0.02, 0.03]}
gravity: [0.0, 9.80665, 0.0]
reference_temperature: 21
compliance: {axial: [1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6], radial: [6e-7, 0, 4e-7, 3e-7, 2e-7, 1e-7]}
effects:
  - {effect: backlash, joint: 3, parameters: {value: 2e-4}}
  - {effect: transmission_error, joint: 2, order: 2.0, parameters: {sine: 1e-4, cosine: -3e-5}}
metrology: {registered: true, sigma: 3.0e-5, repeatability: 1.5e-5}
"""))  # fmt: skip
    model = cell.model
    cr, sr, cp, sp, cy, sy = (
        f(a) for a in (0.1, -0.2, 0.3) for f in (np.cos, np.sin)
    )  # fmt: skip
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    np.testing.assert_allclose(model.tool_in_flange[:3, :3], Rz @ Ry @ Rx, atol=1e-15)
    np.testing.assert_array_equal(model.tool_in_flange[:3, 3], [0.1, 0.2, 0.3])
    assert model.payload_mass == 4.5
    np.testing.assert_array_equal(model.payload_cog, [0.01, 0.02, 0.03])
    np.testing.assert_array_equal(model.gravity, [0, 9.80665, 0])
    assert model.reference_temperature == 21.0
    axial, radial = model.compliance()
    np.testing.assert_array_equal(axial, [1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6])
    np.testing.assert_array_equal(radial, [6e-7, 0, 4e-7, 3e-7, 2e-7, 1e-7])
    backlash, wave = model.terms[-2:]
    assert (backlash.effect, backlash.site.joint, backlash.values) == ("backlash", 3, (2e-4,))
    assert (wave.site.order, wave.values) == (2.0, (1e-4, -3e-5))
    metrology = cell.metrology
    assert (metrology.registered, metrology.sigma, metrology.repeatability) == (True, 3e-5, 1.5e-5)


def test_defaults_are_those_of_the_contract(tmp_path: Path) -> None:
    cell = load_cell(written(tmp_path, ARM))
    assert cell.model.terms == ()
    assert cell.model.payload_mass == 0.0
    assert cell.model.reference_temperature == 25.0
    np.testing.assert_array_equal(cell.model.gravity, [0, 0, -9.80665])
    assert (cell.metrology.registered, cell.metrology.sigma) == (False, 2e-5)
    assert cell.metrology.repeatability is None


def test_keys_with_nothing_behind_them_count_as_left_out(tmp_path: Path) -> None:
    assert load_cell(written(tmp_path, ARM + "payload:\neffects:\n")).model.payload_mass == 0.0


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("robot:\n\tmodel: ur10e", "line 2: found a tab, expected spaces"),
        (f"{ARM}---\n{ARM}", "line 2: found a second document (---), expected one cell"),
        ("robot: !!python/name:os.system", "line 1: found a tag (!), expected plain values"),
        ("robot: [", "line 1: found broken YAML"),
    ],
)
def test_text_that_is_no_plain_yaml_is_reported(tmp_path: Path, text: str, phrase: str) -> None:
    assert phrase in reported(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("robot: {modle: ur10e}", "'modle' 'model'"),
        (ARM + "efects: []", "'efects' 'effects'"),
        (ARM + "payload: {mas: 5}", "payload.mas 'mass'"),
        (ARM + "limits: {ofset: 0.01}", "limits.ofset 'offset'"),
        (ARM + "link: {driver: ur_rtde, hst: 127.0.0.2}", "link.hst 'host'"),
        (ARM + "recording: {foldr: x}", "recording.foldr 'folder'"),
        ("robot: {dh: [{a: 1, alpha: 0, d: 0, of: 1}]}", "'of' 'offset'"),
        ("robot: {model: ur10e, calibration: {delta_thet: [1]}}", "delta_thet 'delta_theta'"),
        (ARM + "limits: {speed: 1}", "limits.speed nearest 'offset_rate'; known joint_margin"),
        (ARM + "qqq: 1", "qqq nearest 'web'; known"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest_known(
    tmp_path: Path, text: str, phrase: str
) -> None:
    line = reported(tmp_path, text)
    assert "unknown key" in line
    for word in phrase.split():
        assert word in line


@pytest.mark.parametrize(
    ("text", "found", "expected"),
    [
        ("robot: {model: ur10f}", "'ur10f'", "ur10e"),
        ("robot: {model: ur10e, urdf: a.urdf}", "model and urdf", "one of model, urdf, dh"),
        ("robot: {}", "none of them", "one of model, urdf, dh"),
        ("robot: {dh: []}", "no rows", "one row"),
        ("robot: {dh: [{a: 1, alpha: 0}]}", "robot.dh entry 1.d: found nothing", "expected m"),
        (ARM + "setpoints: {file: 5}", "setpoints.file: found 5", "expected a path"),
        (ARM + "web: {port: 0}", "web.port: found 0", "expected 1 or more"),
        (ARM + "metrics: {port: 0}", "metrics.port: found 0", "expected 1 or more"),
        ("robot: {dh: [{a: 1, alpha: 0, d: x}]}", "'x'", "a number"),
        ("robot: {urdf: none.urdf}", "none.urdf", "URDF"),
        (f"robot: {{urdf: {'x' * 300}}}", "file not found", "URDF"),
        ("robot: ur10e", "'ur10e'", "keys with values"),
        ("tool: {}", "robot: found nothing", "model, urdf or dh"),
        (ARM + "payload: {mass: -1}", "payload.mass: found -1", "0 or more (kg)"),
        (ARM + "payload: {mass: 500}", "500 kg, out of range", "0 to 12.5 kg"),
        (ARM + "payload: {mass: .nan}", "nan", "a finite number"),
        (ARM + "payload: {mass: true}", "True", "a number"),
        (ARM + "payload: {mass: heavy}", "'heavy'", "a number"),
        (ARM + "payload: {cog: [0, 0]}", "2 values", "3 values"),
        (ARM + "gravity: 9.81", "9.81", "a list"),
        (ARM + "tool: {tcp: {xyz: [0, 0, .inf]}}", "tool.tcp.xyz entry 3: found inf", "finite"),
        (ARM + "compliance: {axial: [1e-6, 1e-6]}", "2 values", "6: the arm (ur10e)"),
        (ARM + "compliance: {axial: [0, 0, -1e-6, 0, 0, 0]}", "entry 3: found -1e-06", "0 or more"),
        (ARM + "effects: [{effect: backlsh}]", "'backlsh'", "'backlash'"),
        (ARM + "effects: [{effect: backlash, joint: 7}]", "found 7", "joint of 1 to 6"),
        (ARM + "effects: [{effect: backlash, joint: 1.5}]", "1.5", "a whole number"),
        (ARM + "effects: [{effect: payload, joint: 2}]", "found 2", "no joint"),
        (ARM + "effects: [{effect: backlash, joint: 2}]", "found nothing", "expected rad"),
        (
            ARM + "effects: [{effect: link_geometry, joint: 1, parameters: {alfa: 1}}]",
            "parameters.alfa", "'alpha'",
        ),
        (
            ARM + "effects: [{effect: backlash, joint: 2, order: 2, parameters: {value: 1}}]",
            "order: found 2", "none for backlash",
        ),
        (ARM + "effects: [{effect: transmission_error, joint: 2}]", "found none", "per turn"),
        (
            ARM + "effects: [{effect: transmission_error, joint: 2, order: -3}]",
            "effects entry 1.order: found -3", "more than 0",
        ),
        (
            ARM + "effects: [{effect: transmission_error, joint: 2, order: 1e9}]",
            "effects entry 1.order: found 1000000000.0", "100000 or less",
        ),
        (
            ARM + "effects:\n" + 2 * "- {effect: backlash, joint: 1, parameters: {value: 1e-3}}\n",
            "line 4: effects entry 2: found the same backlash as in entry 1", "it once",
        ),
        (ARM + "metrology: {registered: 1}", "found 1", "true or false"),
        (ARM + "metrology: {sigma: -1}", "found -1", "0 or more"),
        (
            ARM + "calibration: {instrument: {kind: typed, unit: mm, sigma: 0.02}}",
            "found 0.02", "less than 0.01 (m",
        ),
        (ARM + "calibration: {instrument: {kind: sphere, radius: 30}}", "found 30", "than 1 (m"),
        (ARM + "link: {host: '10.0.0.2:30004'}", "'10.0.0.2:30004'", "without a port"),
        (ARM + "link: {host: 192.168.0..10}", "link.host: found '192.168.0..10'", "its labels"),
        (
            ARM + "link: {driver: modbus, profile: ur, host: 'a b'}", "link.host: found 'a b'",
            "expected an IPv4 address or host name without a port",
        ),
        (ARM + f"link: {{host: {'a' * 64}.local}}", "link.host: found", "1 to 63 characters"),
        (ARM + "limits: {offset: 3}", "limits.offset: found 3", "0.1 or less"),
        ("robot: {model: ur10e, calibration: {delta_a: [1]}}", "1 values", "6"),
        ("robot: {model: ur10e, calibration: c.conf}", "file not found", "calibration.conf"),
        ("5: 6\nrobot: {model: ur10e}", "line 1: 5: found a key 5", "a word"),
        (ARM + "payload: {mass: 5, 6: 7}", "line 2: payload.6: found a key 6", "a word"),
        (ARM + "link: {driver: ur_rtde, 6: 7}", "line 2: link.6: found a key 6", "a word"),
        (
            ARM + "calibration: {instrument: {kind: file, file: r.csv}}",
            "calibration.instrument.unit: found nothing", "of lengths",
        ),
        (
            ARM + "calibration: {instrument: {kind: file, path: r.csv, unit: mm}}",
            "unknown key 'path' in calibration.instrument", "known here",
        ),
        (
            ARM + "calibration: {instrument: {kind: line_feed, unit: mm, port: 5000, tiemout: 3}}",
            "unknown key 'tiemout' in calibration.instrument", "did you mean 'timeout'?",
        ),
        (ARM + "payload: {mass: 010}", "line 2: payload.mass: found '010'", "leading zeros"),
        (ARM + "payload: {mass: 1_0}", "line 2: payload.mass: found '1_0'", "a number"),
        (ARM + "payload: {mass: 1_0.5}", "line 2: payload.mass: found '1_0.5'", "a number"),
        (ARM + "payload: {mass: 1_0e2}", "line 2: payload.mass: found '1_0e2'", "a number"),
        (ARM + "recording: {every: 1:30}", "line 2: recording.every: found '1:30'", "or colons"),
        (ARM + "recording: {folder: 5}", "recording.folder: found 5", "expected a path"),
        (ARM + "recording: {every: 1e30}", "recording.every: found 1e+30", "expected a whole"),
        (ARM + "provenance: {intervals: {x: [1]}}", "provenance.intervals.x entry 2", "95 %"),
        (
            ARM + "effects: [{effect: backlash, joint: 2, parameters: {value: x}}]",
            "effects entry 1.parameters.value: found 'x'", "a number",
        ),
        (ARM + "link: {torque_constants: [1, 1]}", "torque_constants: found 2 values", "6 values"),
        (
            ARM + "link: {torque_constants: [1, 1, 1, 1, 1, 0]}",
            "link.torque_constants entry 6: found 0", "more than 0",
        ),
        (ARM + "ft_sensor: {driver: robotous_rft, force_counts: .inf}", "_counts", "finite"),
        (
            ARM + "calibration: {instrument: {kind: dial_gauge, unit: mm, zero: .nan}}",
            "instrument.zero: found nan", "finite",
        ),
        (ARM + "link: {driver: can, profile: piper, gear: [.inf]}", "gear entry 1", "finite"),
        (ARM + "link: {driver: can, profile: piper, zero: [.nan]}", "zero entry 1", "finite"),
        (
            ARM + "link: {driver: can, profile: piper, options: {a: [1]}}",
            "link.options.a: found [1]", "expected",
        ),
        (
            ARM + "provenance: {parameters: [payload], covariance: [[-1]]}",
            "provenance.covariance: found [[-1]]", "variances of 0 or more: that of entry 1",
        ),
        (
            ARM + "provenance: {parameters: [payload]}",
            "provenance.covariance: found []", "1 rows of 1 numbers",
        ),
    ],
)  # fmt: skip
def test_a_wrong_value_is_reported_with_what_was_expected(
    tmp_path: Path, text: str, found: str, expected: str
) -> None:
    line = reported(tmp_path, text)
    assert found in line
    assert expected in line


@pytest.mark.parametrize(
    ("section", "keys", "found", "expected"),
    [
        ("limits", "offset_rate: true", "True", "a number"),
        ("limits", "ramp_time: yes", "True", "a number"),
        ("limits", "offset: '0.005'", "'0.005'", "a number"),
        ("link", "rate: true", "True", "a number"),
        ("setpoints", "arm: 'on'", "'on'", "true or false"),
        ("setpoints", "arm: 1", "1", "true or false"),
        ("recording", "every: true", "True", "a whole number"),
        ("recording", "every: '2'", "'2'", "a whole number"),
        ("web", "port: true", "True", "a whole number"),
    ],
)
def test_numbers_and_booleans_of_every_section_are_taken_literally(
    tmp_path: Path, section: str, keys: str, found: str, expected: str
) -> None:
    line = reported(tmp_path, f"{ARM}{section}: {{{keys}}}")
    key = keys.split(":")[0]
    assert f", line 2: {section}.{key}: found {found}, expected {expected} (" in line


def test_a_list_of_the_right_length_is_not_reported_for_its_length(tmp_path: Path) -> None:
    path = written(tmp_path, ARM + "link: {torque_constants: [1, 1, 1, 1, .nan, -1]}")
    assert [line.split(": ")[1] for line in cell_errors(path)] == [
        "link.torque_constants entry 5",
        "link.torque_constants entry 6",
    ]


def test_a_whole_number_may_be_a_float_and_a_float_whole(tmp_path: Path) -> None:
    text = "limits: {ramp_time: 1}\nlink: {driver: can, profile: piper, bitrate: 5e5}\n"
    cell = load_cell(written(tmp_path, ARM + text))
    assert cell.limits.ramp_time == 1.0
    assert cell.link is not None
    assert getattr(cell.link, "bitrate", None) == 500_000


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("robot: [1, 2", "line 1"),
        (ARM + "tool:\n\txyz: 1", "line 3"),
        (ARM + "tool: {}\nrobot: 5", "line 3: robot: found twice"),
        (ARM + "payload: {<<: {mass: 1}, <<: {mass: 2}}", "line 2: <<: found twice"),
        (
            ARM + "link: {driver: }",
            "line 2: link.driver: found '', expected one of 'ur_rtde', 'mod",
        ),
        (ARM + "link: {driver: [a]}", "line 2: link.driver: found \"['a']\", expected one of 'ur_"),
        ("", "empty"),
        ("just words", "no keys"),
        ("robot: !!python/object:os.system []", "line 1"),
        ("robot: &a [*a]", "robot"),
        (ARM + "payload: {mass: 5,5}", "line 2: mass: found a decimal comma (5,5), expected a"),
        (ARM + "limits: {offset: 0,05}", "line 2: offset: found a decimal comma (0,05)"),
        (ARM + f"payload: {{mass: {'9' * 5000}}}", "line 2: found '9999"),
        (f"robot: {'[' * 3000}", "found values nested too deep, expected a few levels"),
        (ARM + 'setpoints: {file: "a\\0b"}', "line 2: found 'a\\x00b', expected no \\0 in it"),
        (
            ARM + 'setpoints: {file: "\\ud800"}',
            "line 2: found '\\ud800', expected no \\ud800 in it",
        ),
        (ARM + "payload: {mass: !!int ''}", "line 2: found '', expected a valid int"),
        (ARM + "payload: {mass: !!float abc}", "line 2: found 'abc', expected a valid float"),
        (ARM + "payload: {mass: !!bool maybe}", "line 2: found 'maybe', expected a valid bool"),
        (ARM + "payload: {mass: !!timestamp abc}", "line 2: found 'abc', expected a valid times"),
        (ARM + "payload: {mass: 2026-13-41}", "line 2: found '2026-13-41', expected a valid times"),
    ],
)
def test_broken_yaml_is_reported_with_its_line(tmp_path: Path, text: str, phrase: str) -> None:
    assert phrase in reported(tmp_path, text)


def test_a_missing_file_a_folder_and_bytes_are_reported(tmp_path: Path) -> None:
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00\x81")
    for path, phrase in (
        (tmp_path / "none.yaml", "file not found"),
        (tmp_path, "found a folder"),
        (tmp_path / "bytes.yaml", "no text"),
        (Path("/dev/null"), "/dev/null: found a device, expected a cell file"),
    ):
        with pytest.raises(CellError, match=phrase):
            load_cell(path)


def test_numbers_without_a_point_are_numbers(tmp_path: Path) -> None:
    text = ARM + "metrology: {sigma: 2e-5}\nreference_temperature: 1E1\n"
    cell = load_cell(written(tmp_path, text))
    assert cell.metrology.sigma == 2e-5
    assert cell.model.reference_temperature == 10.0


def test_a_payload_above_the_rated_one_is_warned_of(tmp_path: Path) -> None:
    (warning,) = load_cell(written(tmp_path, ARM + "payload: {mass: 14}")).warnings
    assert "14 kg" in warning
    assert "12.5 kg" in warning


def test_a_urdf_is_found_beside_the_cell(tmp_path: Path) -> None:
    (tmp_path / "deeper").mkdir()
    robot = (CONFIG / "seven_axis.urdf").read_text(encoding="utf-8")
    (tmp_path / "deeper" / "arm.urdf").write_text(robot, encoding="utf-8")
    cell = load_cell(written(tmp_path, "robot: {urdf: deeper/arm.urdf, tip: link_7}"))
    assert cell.arm.n == 7
    assert np.allclose(cell.arm.link_in_link[7], np.eye(4))


def test_a_urdf_of_links_that_are_nested_too_deep_is_refused(tmp_path: Path) -> None:
    joint = '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{0}"/></joint>'
    chain = [f'<link name="b{i}"/>{joint.format(f"b{i}", "fixed", f"b{i - 1}")}'
             for i in range(1, 1500)]  # fmt: skip
    (tmp_path / "arm.urdf").write_text(
        f'<robot name="r"><link name="b0"/><link name="t"/>{joint.format("t", "revolute", "b0")}'
        f"{''.join(chain)}</robot>"
    )
    assert "arm.urdf: found links nested too deep" in reported(
        tmp_path, "robot: {urdf: arm.urdf, tip: t}"
    )


def test_a_factory_calibration_moves_the_arm_as_its_deltas_say(tmp_path: Path) -> None:
    (tmp_path / "calibration.conf").write_text(
        "[mounting]\n"
        "delta_theta = [ 0.001, 0.0, 0.0, 0.0, 0.0, 0.0 ]\n"
        "delta_a = [ 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 ]\n"
        "delta_d = [ 0.002, 0.0, 0.0, 0.0, 0.0, 0.0 ]\n"
        "delta_alpha = [ 0.0, 0.0, 0.0, 0.0, 0.0, 0.0 ]\n"
        "calibration_status = 0\njoint_checksum = [ 0x1, 0x2 ]\n"
    )
    inline = "{delta_theta: [0.001, 0, 0, 0, 0, 0], delta_d: [0.002, 0, 0, 0, 0, 0]}"
    q = np.array([[0.3, -1.2, 1.4, -0.5, 0.8, 0.1]])
    nominal = load_cell(written(tmp_path, ARM)).model.rigid_pose(q).position[0]
    expected = rotation_matrix(np.array([0, 0, 0.001])) @ nominal + [0, 0, 0.002]
    for value in ("calibration.conf", inline):
        text = f"robot: {{model: ur10e, calibration: {value}}}"
        moved = load_cell(written(tmp_path, text)).model.rigid_pose(q).position[0]
        np.testing.assert_allclose(moved, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("no ini", "c.conf: found no sections of keys and values, expected a calibration.conf"),
        ("[a]\nb = 1", "none of"),
        ("[a]\ndelta_a = x", "c.conf: delta_a: found 'x', expected a list of finite numbers"),
        ("[a]\ndelta_a = [0, NaN]", "c.conf: delta_a: found '[0, NaN]', expected a list of fin"),
        ("[a]\ndelta_a = [0, 0]", "robot.calibration: {}/c.conf: delta_a: found 2 values"),
        ("\ufeff[a]\ndelta_a = [0, 0]", "delta_a: found 2 values"),
        ("[a]\ndelta_a = [true, 0, 0, 0, 0, 0]", "delta_a: found '[true, 0, 0, 0, 0, 0]'"),
        ('[a]\ndelta_a = "123456"', "a list of finite numbers"),
        (f"[a]\ndelta_a = {'[' * 100_000}", "a list of finite numbers"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_reported(
    tmp_path: Path, text: str, phrase: str
) -> None:
    (tmp_path / "c.conf").write_text(text, encoding="utf-8")
    assert phrase.format(tmp_path) in reported(
        tmp_path, "robot: {model: ur10e, calibration: c.conf}"
    )
