import json
import sqlite3
import struct

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from benchmarks.real import arms, rivals
from benchmarks.real.absurd import absurdities
from benchmarks.real.convert import SOURCES, main, write
from benchmarks.real.geometry import (
    Fit,
    fit_geometry,
    free_numbers,
    points,
    registered,
    rough_turn,
    tool_step,
)
from benchmarks.real.judging import Program, judge_carried, ratio_error
from benchmarks.real.table import Table, halves, read_table

RNG = np.random.default_rng(7)


def table(**columns):
    names, values = [], []
    for name, column in columns.items():
        wide = np.asarray(column, dtype=float).reshape(len(column), -1)
        names += [name] if np.ndim(column) == 1 else [f"{name}_{k}" for k in range(wide.shape[1])]
        values.append(wide)
    return Table(tuple(names), np.hstack(values))


def poses(count=150):
    return RNG.uniform(-1.5, 1.5, (count, 6))


def test_geometry_and_tool_are_found_in_another_frame():
    q, session = poses(), np.zeros(150, dtype=np.int64)
    change = np.zeros((6, 5))
    for i, kind in free_numbers(arms.UR10):
        change[i, kind] = RNG.normal() * 1e-3
    tool = np.array([[0.01, -0.02, 0.11]])
    true = points(arms.UR10, q, Fit(change, tool), session)
    turned = true @ arms.flange(arms.UR10, q[:1])[1][0].T + [1, 2, 3]
    fit = fit_geometry(arms.UR10, q, turned, session, np.array([0, 0, 0.1]))
    left = turned - registered(points(arms.UR10, q, fit, session), turned)
    assert np.sqrt(np.mean(left**2)) < 5e-6


def test_bias_and_weight_of_a_sensor_are_taken_out():
    q = poses(40)
    _, R = arms.flange(arms.UR10, q)
    down = np.einsum("nji,j->ni", R, [0, 0, -9.80665])
    wrench = np.hstack([1.2 * down + [1, 2, 3], 1.2 * np.cross([0, 0.01, 0.1], down) + 0.5])
    log = table(timestamp=np.arange(40) * 10.0, actual_q=q, ft_raw_wrench=wrench)
    cell = {"robot": {"dh": [link.document() for link in arms.UR10]}}
    assert np.abs(rivals.wrench_corrected(cell, log, log).get("ft_raw_wrench")).max() < 1e-9


def test_one_delay_a_joint_is_found():
    time = np.arange(2000) * 0.004
    delay = np.array([0.01, 0.03])
    wave = [np.sin((1.3 + j) * (time - d)) for j, d in enumerate(delay)]
    target = np.column_stack([np.sin((1.3 + j) * time) for j in range(2)])
    log = table(timestamp=time, target_q=target, actual_q=np.column_stack(wave))
    fitted, judged = (log.rows(keep) for keep in halves(log))
    left = rivals.tracking_left(fitted, judged)
    assert left.shape == judged.joints().shape
    assert np.isnan(left[:7]).all()  # their delayed target is not in the log
    assert np.sqrt(np.mean(left[20:] ** 2)) < 1e-5


def test_base_parameters_and_friction_are_found(tmp_path):
    pin = pytest.importorskip("pinocchio")
    time = np.arange(1500) * 0.01
    rate = RNG.uniform(0.5, 2.0, (6, 3))
    phase = RNG.uniform(-3, 3, (6, 3))
    angle = time[:, None, None] * rate + phase
    q, qd, qdd = ((np.sin(angle + k * np.pi / 2) * rate**k * 0.4).sum(axis=2) for k in range(3))
    model = rivals.pinocchio_model(
        {"robot": {"dh": [x.document() for x in arms.UR10E]}}, tmp_path, pin
    )
    for i, link in enumerate(arms.UR10E):
        model.inertias[i + 1] = pin.Inertia(link.mass, np.array(link.cog), 0.02 * np.eye(3))
    data = model.createData()
    torque = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
    torque += 3 * np.sign(qd) + 2 * qd
    log = table(timestamp=time, actual_q=q, actual_qd=qd, actual_current_as_torque=torque)
    cell = {"robot": {"dh": [x.document() for x in arms.UR10E]}}
    fitted, judged = (log.rows(keep) for keep in halves(log))
    nominal = np.ones((len(judged), 6))
    gap = judged.get("actual_current_as_torque") - nominal
    left = rivals.torque_corrected(cell, tmp_path, fitted, judged, gap)
    gap = left.get("actual_current_as_torque") - nominal
    assert np.isfinite(gap).all(axis=1).sum() > 0.8 * len(judged)
    assert np.sqrt(np.nanmean(gap**2)) < 0.05 * np.sqrt(np.mean(torque**2))


def test_a_recording_is_judged_on_its_end_and_poses_at_random():
    q = poses(50)
    moving = table(timestamp=np.arange(50) * 0.01, actual_q=q)
    at_rest = table(timestamp=np.arange(50) * 30.0, actual_q=q)
    assert halves(moving)[1].nonzero()[0].tolist() == list(range(40, 50))
    assert halves(moving, seed=3)[1].nonzero()[0].tolist() == list(range(10, 20))
    fitted, judged = halves(at_rest)
    assert judged.sum() == 10 and not (fitted & judged).any()
    assert np.ptp(judged.nonzero()[0]) > 15
    fitted, judged = halves(at_rest, seed=1, poses=12)
    assert fitted.sum() == 12 and judged.sum() == 38 and not (fitted & judged).any()
    assert (fitted != halves(at_rest, seed=2, poses=12)[0]).any()


@pytest.mark.parametrize(
    ("effect", "name", "value", "absurd"),
    [
        ("payload", "payload", -681.7, True),
        ("payload", "payload", 0.4, False),
        ("axial_compliance", "axial_compliance_2", -1e-6, True),
        ("link_geometry", "link_geometry_3_a", 0.1, True),
        ("link_geometry", "link_geometry_3_a", 0.001, False),
        ("viscous_friction", "viscous_friction_3", -2.0, True),
    ],
)
def test_what_no_engineer_believes_is_absurd(effect, name, value, absurd):
    cause = {"effect": effect, "parameters": [{"name": name, "value": value, "std": 1e-9}]}
    assert bool(absurdities([cause], 1.0, 5.0)) is absurd


def test_a_value_within_its_own_spread_is_absurd():
    cause = {"effect": "backlash", "parameters": [{"name": "backlash_2", "value": 1e-4,
                                                   "std": 1e-4}]}  # fmt: skip
    assert absurdities([cause], 0, 0) == ["backlash (no number of it over 3 sigma)"]


@pytest.mark.parametrize(("gain", "absurd"), [(0.4, False), (-0.1, True)])
def test_all_links_together_are_judged_by_what_they_gain(gain, absurd):
    numbers = [{"name": f"link_geometry_{i}_a", "value": 1e-4, "std": 1e-4} for i in (1, 2)]
    cause = {"effect": "link_geometry", "joints": [1, 2], "parameters": numbers,
             "shrink_interval": [gain, 0.6]}  # fmt: skip
    assert bool(absurdities([cause], 0, 0)) is absurd


def test_a_line_is_judged_by_its_amplitude_whatever_its_name_holds():
    name = "transmission_error_3_order81"
    line = [{"name": f"{name}_amplitude", "value": 7.2e-5, "std": 6.8e-6},
            {"name": f"{name}_phase", "value": 1.9, "std": 0.1}]  # fmt: skip
    assert absurdities([{"effect": "transmission_error", "parameters": line}], 0, 0) == []


def test_a_clone_becomes_a_log_and_a_cell(tmp_path):
    source = SOURCES["force_sensor_100"]
    place = tmp_path / source.folder / "datas"
    place.mkdir(parents=True)
    turn = RNG.normal(size=(9, 4))
    pose = np.hstack([np.zeros((9, 3)), turn / np.linalg.norm(turn, axis=1)[:, None]])
    np.savetxt(place / "recorded_messages_pose_100.txt", pose, delimiter=",")
    np.savetxt(place / "recorded_messages_wrench_100.txt", np.tile([0, 0, -9.0, 0, 0, 0], (9, 1)),
               delimiter=",")  # fmt: skip
    write(tmp_path / "out", source, source.make(tmp_path / source.folder))
    log = read_table(tmp_path / "out/log.csv")
    _, R = arms.flange(arms.WRIST, log.joints())
    force = np.einsum("nij,nj->ni", R, log.get("ft_raw_wrench")[:, :3])
    assert force == pytest.approx(np.tile([0, 0, -9.0], (9, 1)), abs=1e-6)
    about = yaml.safe_load((tmp_path / "out/ABOUT.yaml").read_text(encoding="utf-8"))
    assert source.repository in about["source"]


def test_a_day_of_an_arm_becomes_a_log_in_metres_with_the_tool_that_suits_it(tmp_path):
    source = SOURCES["aubo_i5_0918"]
    place = tmp_path / source.folder / "dataLib/kinematicsCalibrationData/Leica0918"
    place.mkdir(parents=True)
    q = RNG.uniform(-1.5, 1.5, (30, 6))
    p, R = arms.flange(arms.AUBO_I5, q)
    measured = 1e3 * (p + R @ [-0.004, -0.009, 0.035] + [1.0, 2.0, 0.0])
    np.savetxt(place / "CAL.txt", q, delimiter=",")
    np.savetxt(place / "mesurements.txt", np.hstack([np.zeros((30, 3)), measured]), delimiter=",")
    made = source.make(tmp_path / source.folder)
    assert made.columns["measured_position"] == pytest.approx(measured / 1e3)
    assert made.cell["tool"]["tcp"]["xyz"] == pytest.approx([-0.004, -0.009, 0.035])


def test_readings_of_one_pose_become_one_row(tmp_path):
    source = SOURCES["meca500_left"]
    place = tmp_path / source.folder / "data_calibration"
    place.mkdir(parents=True)
    q = RNG.uniform(-1.5, 1.5, (20, 6))
    p, R = arms.flange(arms.MECA500, q)
    measured = np.repeat(p + R @ [-0.088, -0.001, 0.061], 3, axis=0)
    measured += np.tile([[-3e-6], [0.0], [3e-6]], (20, 1))
    rows = np.hstack([np.repeat(np.degrees(q), 3, axis=0), measured])
    for size, part in (("Large160", rows[:30]), ("Small80", rows[30:])):
        np.savetxt(place / f"CAL00005_Left_{size}_Output.csv", part, delimiter=",")
    made = source.make(tmp_path / source.folder)
    assert made.columns["actual_q"] == pytest.approx(q)
    assert made.columns["measured_position"] == pytest.approx(measured[1::3])


def test_a_bag_of_joint_states_becomes_columns(tmp_path):
    source = SOURCES["ur10_excitation"]
    path = tmp_path / "ur10_inverse_dynamics_solver/bagfiles/ur10_exciting_trajectory.db3"
    path.parent.mkdir(parents=True)
    values = RNG.normal(size=(4, 3, 6))
    with sqlite3.connect(path) as bag:
        bag.execute("create table messages (timestamp integer, data blob)")
        for k, message in enumerate(values):
            vectors = b"".join(struct.pack("<II6d", 6, 0, *vector) for vector in message)
            bag.execute("insert into messages values (?, ?)", (k, b"head, names" + vectors))
    columns = source.make(tmp_path).columns
    for k, name in enumerate(("actual_q", "actual_qd", "actual_current_as_torque")):
        assert columns[name] == pytest.approx(values[:, k])


def test_sets_that_are_not_there_are_skipped_by_name(tmp_path):
    from click.testing import CliRunner

    done = CliRunner().invoke(main, [str(tmp_path), "--out", str(tmp_path / "out")])
    assert done.exit_code == 0
    assert "panda: skipped, no clone of github.com/" in done.output


def test_the_error_of_a_ratio_is_the_scatter_of_ratios_of_logs_drawn_anew():
    """Poses: samples of their own. A recording: an error that lasts is one sample a stretch."""
    rng = np.random.default_rng(3)
    draws = rng.normal(size=(300, 2, 80, 3)) * [[[1.0]], [[1.2]]]
    ratios = [np.sqrt(np.mean(a**2) / np.mean(b**2)) for a, b in draws]
    estimated = [ratio_error(a, b, moving=False) for a, b in draws]
    assert np.median(estimated) == pytest.approx(np.std(ratios), rel=0.15)
    lasting = np.repeat(rng.normal(size=(300, 2, 10, 3)), 50, axis=2)
    ratios = [np.sqrt(np.mean(a**2) / np.mean(b**2)) for a, b in lasting]
    estimated = [ratio_error(a, b, moving=True) for a, b in lasting]
    assert np.median(estimated) == pytest.approx(np.std(ratios), rel=0.3)
    left_out = np.where(np.arange(80)[:, None] < 5, np.nan, draws[0, 0])
    assert np.isfinite(ratio_error(left_out, draws[0, 1], moving=True))


def log_of_weight(folder, count=40):
    q = poses(count)
    _, R = arms.flange(arms.UR10, q)
    down = np.einsum("nji,j->ni", R, [0, 0, -9.80665])
    wrench = np.hstack([1.2 * down + [4, 2, 3], 1.2 * np.cross([0, 0.01, 0.1], down) + 0.5])
    log = table(timestamp=np.arange(count) * 10.0, actual_q=q,
                ft_raw_wrench=wrench + RNG.normal(size=wrench.shape) * 0.02)  # fmt: skip
    folder.mkdir()
    log.write(folder / "log.csv")
    cell = {"robot": {"dh": [link.document() for link in arms.UR10]}}
    (folder / "cell.yaml").write_text(yaml.safe_dump(cell), encoding="utf-8")
    return folder


@pytest.mark.slow
def test_a_log_of_weight_alone_is_judged_beside_least_squares(tmp_path):
    from click.testing import CliRunner

    from benchmarks.real.__main__ import main as judge

    log_of_weight(tmp_path / "one")
    done = CliRunner().invoke(judge, ["--data", str(tmp_path), "--json", str(tmp_path / "o.json")])
    assert done.exit_code == 0, done.output
    (outcome,) = json.loads((tmp_path / "o.json").read_text(encoding="utf-8"))
    assert outcome["channel"] == "wrench"
    assert outcome["rival"] < 0.1
    assert outcome["gap"] > 1.0
    assert 0 < outcome["ratio_error"] < 0.5
    assert outcome["ratio"] == pytest.approx(outcome["judged"] / outcome["rival"])


@pytest.mark.slow
def test_an_answer_that_is_carried_to_several_logs_is_found_once(tmp_path):
    class Counting(Program):
        found = 0

        def __call__(self, *arguments):
            self.found += "--apply" in arguments
            super().__call__(*arguments)

    program = Counting()
    first, *later = (log_of_weight(tmp_path / name) for name in "abc")
    outcomes = list(judge_carried(first, later, program))
    assert [o.log for o in outcomes] == ["a > b", "a > c"]
    assert [o.judged / o.rival < 1.1 for o in outcomes] == [True, True]
    assert outcomes[0].judged != outcomes[1].judged
    assert program.found == 1


def test_the_turn_of_a_probe_on_its_flange_is_found():
    """An instrument that stands elsewhere, a probe that is mounted turned about the flange."""
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.5, 1.5, (40, len(arms.IIWA7)))
    at, turned = arms.flange(arms.IIWA7, q)
    tool, mounted = np.array([0.0, 0.01, 0.03]), Rotation.from_euler("xyz", [0.02, 0, -0.39])
    frame = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    p = (at + turned @ tool) @ frame.T + [1.0, 2.0, 0.5] + rng.normal(0, 1e-4, (40, 3))
    found = rough_turn(arms.IIWA7, q, tool, p, frame @ turned @ mounted.as_matrix())
    assert np.allclose(found, [0.02, 0, -0.39], atol=1e-9)


def test_last_motions_are_those_of_the_whole_log():
    q = np.array([[0.0, 1.0], [0.1, 1.0], [0.1, 0.9], [0.0, 0.9], [0.2, 0.9]])
    log = table(timestamp=np.arange(5) * 10.0, session=[0, 0, 0, 1, 1], actual_q=q)
    found = log.with_approach().rows(np.array([False, False, True, True, True]))
    assert found.get("approach").tolist() == [[1, -1], [0, 0], [1, 0]]


def test_a_target_mounted_anew_is_found_from_predicted_poses():
    q, tool = poses(40), np.array([0.01, -0.02, 0.11])
    at, R = arms.flange(arms.UR10, q)
    turn = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    measured = (at + R @ tool) @ turn.T + [1, 2, 3]
    nominal = at + R @ np.array([0, 0, 0.1])
    assert np.abs(tool_step(nominal, R, measured) - (tool - [0, 0, 0.1])).max() < 1e-9
