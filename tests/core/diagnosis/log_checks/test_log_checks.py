"""Mistakes of units, names, clocks, frames and signs are called by their name."""

from __future__ import annotations

import contextlib
import warnings
from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest
import small_arm as small
from scipy.spatial.transform import Rotation

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.diagnosis.log_checks.units_and_clocks import ColumnsAndOrder, check_units
from gapbridge.core.diagnosis.log_checks.units_and_clocks import findings as log_findings
from gapbridge.core.dynamics import predict_wrench
from gapbridge.core.errors import LogError
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.motion import Motion

MODEL = small.model_of()
SESSION = small.session_of()
AXIAL = replace(small.NOMINAL, axial=np.array(small.KIND.axial))
READ = small.readings(AXIAL, SESSION)
LOG = small.log_of(SESSION, READ)
REGISTERED = Metrology(registered=True, sigma=small.SIGMA)
FREE = Metrology(sigma=small.SIGMA)


def with_columns(**more) -> Log:
    return small.log_of(SESSION, READ, **more)


def findings(log: Log, *cell) -> list[str]:
    return [log_finding_text(finding) for finding in log_findings(log, *cell)]


def reported(log: Log, metrology: Metrology = REGISTERED) -> str:
    return "\n".join(findings(log, MODEL, metrology))


def rotations() -> Rotation:
    return Rotation.from_matrix(MODEL.rigid_pose(SESSION.q).rotation)


def test_a_sound_log_is_not_suspected():
    log = with_columns(measured_rotation=rotations().as_rotvec())
    check_units(MODEL, log)
    assert findings(log, MODEL, REGISTERED) == []
    assert findings(log, MODEL, FREE) == []


WRONG_UNITS = {
    "actual_q": (np.degrees(SESSION.q), "degrees"),
    "target_q": (np.degrees(SESSION.q), "degrees"),
    "measured_position": (READ * 1e3, "millimetres"),
    "measured_rotation": (rotations().as_rotvec(degrees=True), "degrees"),
    "payload": (SESSION.payload_mass * 1e3, "grams"),
    "payload_cog": (SESSION.payload_cog * 1e3, "mm"),
    "joint_temperatures": (SESSION.temperature + 273.15, "kelvin"),
}


@pytest.mark.parametrize("name", WRONG_UNITS)
def test_a_wrong_unit_is_refused_by_name(name):
    values, unit = WRONG_UNITS[name]
    with pytest.raises(LogError, match=rf"small.csv: columns? {name}.*found .*{unit}, expected"):
        check_units(MODEL, with_columns(**{name: values}))


def test_degrees_within_a_few_turns_of_the_range_are_still_degrees():
    small_angles = np.degrees(SESSION.q) / 10  # at most 15: as radians beyond any limit
    with pytest.raises(LogError, match="degrees"):
        check_units(MODEL, with_columns(actual_q=small_angles))


def test_one_slip_in_a_column_is_no_unit():
    payload, warm = SESSION.payload_mass.copy(), SESSION.temperature.copy()
    payload[3], warm[3] = 5000.0, 300.0
    check_units(MODEL, with_columns(payload=payload, joint_temperatures=warm))


def test_an_empty_column_is_no_unit():
    nothing = np.full_like(READ, np.nan)
    check_units(MODEL, with_columns(measured_position=nothing, payload_cog=nothing))


@pytest.mark.parametrize(("column", "size"), [("actual_q", 1e3), ("measured_position", 1e6)])
def test_a_coordinate_without_a_number_is_no_warning_of_numpy(column, size):
    values = size * (SESSION.q if column == "actual_q" else READ)
    values[:, 1] = np.nan
    log = with_columns(**{column: values})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with contextlib.suppress(LogError):
            check_units(MODEL, log)
        findings(log, MODEL, REGISTERED)


def test_without_a_rated_payload_grams_are_detected_by_the_arms_mass():
    unrated = replace(MODEL, arm=replace(MODEL.arm, payload=np.inf))
    check_units(unrated, LOG)
    with pytest.raises(LogError, match="grams"):
        check_units(unrated, with_columns(payload=SESSION.payload_mass * 1e3))
    weightless = replace(unrated, arm=replace(unrated.arm, mass=np.zeros(3)))
    check_units(weightless, with_columns(payload=SESSION.payload_mass * 1e3))


def test_joints_that_were_moved_by_whole_turns_are_named():
    (line,) = findings(replace(LOG, turned=(2, 6)), MODEL, REGISTERED)
    assert "joint(s) 2, 6 jump by whole turns" in line


def test_speeds_that_were_left_out_are_reported():
    log = replace(with_columns(), wrong_speeds=((1, 2), 57.3))
    assert "actual_qd of joint(s) 1, 2 is 57.3 times what" in reported(log)


def test_fahrenheit_is_reported():
    assert "Fahrenheit" in reported(with_columns(joint_temperatures=SESSION.temperature * 1.8 + 70))


def test_a_misspelt_column_is_reported_with_what_it_may_mean():
    log = replace(with_columns(payload=None), unknown=("paylod", "comment", "payload_mass"))
    (line,) = findings(log, MODEL, REGISTERED)
    assert "paylod" in line
    assert "did you mean payload?" in line


def test_repeated_and_backward_timestamps_are_counted():
    time = SESSION.time.copy()
    time[5], time[10] = time[4], time[8]
    lines = findings(with_columns(timestamp=time))
    assert lines == [
        "1 timestamp(s) are repeated",
        "1 timestamp(s) run backwards (the first is row 12): rows should be in time order",
    ]


@pytest.mark.parametrize("rows", [1, 2, 3, 9])
def test_rows_out_of_order_are_counted_across_pieces_and_a_new_session_may_restart(rows):
    time, session = np.array([5.0, 6, 7, 6.5, 8, 0, 1, 0.5, 2]), np.array([1.0] * 5 + [2.0] * 4)
    log, checked = Log("log.csv", {"timestamp": time, "session": session}, 3), ColumnsAndOrder()
    for first in range(0, len(time), rows):
        checked.add(log.select(slice(first, first + rows)))
    (found,) = checked.findings()
    assert log_finding_text(found).startswith("2 timestamp(s) run backwards (the first is row 5)")


def test_the_clock_of_a_recording_that_repeats_is_reported():
    t = np.arange(500) / 100
    q = np.outer(np.sin(t), [0.3, 0.2, 0.1])
    columns = {"timestamp": np.round(t, 1), "actual_q": q}
    (line,) = findings(Log("moving.csv", columns, 3))
    assert "rounded to 0.1 s" in line


@pytest.mark.parametrize(
    ("name", "phrase"),
    [
        ("measured_position", "measured position (empty, or three zeros)"),
        ("ft_raw_wrench", "wrench"),
    ],
)
def test_rows_without_a_reading_are_counted(name, phrase):
    values = READ.copy() if name == "measured_position" else np.zeros((len(READ), 6))
    values[[3, 7], 0] = np.nan
    assert f"2 row(s) have no {phrase} and were left out" in findings(
        with_columns(**{name: values})
    )


def test_constant_positions_and_few_poses_are_reported():
    assert "hardly change" in reported(with_columns(measured_position=np.ones_like(READ)))
    few = LOG.select(np.arange(5))
    assert "5 different pose(s) are few" in reported(few)
    assert "are few" not in reported(LOG.select(np.arange(40)))


def test_joints_beyond_the_limits_are_reported():
    q = SESSION.q.copy()
    q[0, 1] = 3.0
    assert "joint(s) 2 are beyond" in reported(with_columns(actual_q=q))


def flipped(joint: int):
    q = SESSION.q.copy()
    q[:, joint - 1] *= -1
    return q


FRAMES = {
    "mirrored": ({"measured_position": READ * [1, -1, 1]}, "mirrored"),
    "sign of a joint": ({"actual_q": flipped(2)}, "joint 2 seems to have the wrong sign"),
    "order of the joints": ({"actual_q": SESSION.q[:, ::-1]}, "in reverse order"),
    "rows late": ({"measured_position": np.roll(READ, 1, axis=0)}, "one row too late"),
    "rows early": ({"measured_position": np.roll(READ, -1, axis=0)}, "one row too early"),
    "inches": ({"measured_position": READ / 0.0254}, "look like inches"),
    "centimetres": ({"measured_position": READ * 100}, "look like centimetres"),
    "another arm": ({"measured_position": np.cos(3 * READ)}, "is it the right arm"),
}


@pytest.mark.parametrize("mistake", FRAMES)
def test_poses_that_cannot_be_the_arms_are_reported_with_the_likely_mistake(mistake):
    columns, phrase = FRAMES[mistake]
    assert phrase in reported(with_columns(**columns), FREE)


def test_positions_in_another_frame_than_declared_are_reported():
    elsewhere = small.readings(AXIAL, SESSION, registered=False)
    log = with_columns(measured_position=elsewhere)
    assert "set metrology.registered to false" in reported(log)
    assert reported(log, FREE) == ""


def test_angles_in_place_of_rotation_vectors_are_reported():
    euler = rotations().as_euler("xyz")
    assert "roll, pitch and yaw" in reported(with_columns(measured_rotation=euler))
    shuffled = rotations().as_rotvec()[::-1]
    assert "rotations do not follow" in reported(with_columns(measured_rotation=shuffled))
    aside = (rotations() * Rotation.from_euler("x", 90, degrees=True)).as_rotvec()
    assert "differ by a constant 1.57 rad" in reported(with_columns(measured_rotation=aside))


def in_tool(pull):
    hand = rotations().inv()
    return np.hstack([hand.apply(pull[:, :3]), hand.apply(pull[:, 3:])])


PULLS = {
    "to have the wrong sign": -SESSION.tcp_wrench,
    "to be in tool axes": in_tool(SESSION.tcp_wrench),
    "to have the wrong sign and to be in tool axes": -in_tool(SESSION.tcp_wrench),
}


@pytest.mark.parametrize("mistake", PULLS)
@pytest.mark.parametrize("nominal", [small.NOMINAL, AXIAL], ids=["rigid model", "soft model"])
def test_a_force_opposite_to_the_deflection_is_reported(mistake, nominal):
    log = with_columns(actual_TCP_force=PULLS[mistake])
    (line,) = findings(log, small.model_of(nominal), FREE)
    assert line.startswith(f"actual_TCP_force seems {mistake};")


def test_a_rigid_arm_shows_no_sign_of_a_pull():
    read = small.readings(small.NOMINAL, SESSION)
    log = small.log_of(SESSION, read, actual_TCP_force=-SESSION.tcp_wrench)
    assert findings(log, MODEL, REGISTERED) == []


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Poses of an arm of Pinocchio's with a flange sensor and joint torques."""
    plant = truth.plant(tmp_path_factory.mktemp("arm"), 7, 1)
    rng = np.random.default_rng(5)
    q, mass = truth.poses(7, 40, 5), rng.choice([2.0, 4.0], 40)
    pull = np.zeros((40, 6))
    pull[::2] = rng.normal(0, 30, (20, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]
    torque, wrench = plant.dynamics(q, 0 * q, 0 * q, pull, mass)
    noise = rng.normal(0, 0.3, wrench.shape)
    columns = {
        "actual_q": q, "payload": mass, "payload_cog": np.tile(truth.COG, (40, 1)),
        "actual_TCP_force": pull, "ft_raw_wrench": wrench + noise + 4.0,
        "actual_current_as_torque": torque,
    }  # fmt: skip
    return plant.model(), columns


@pytest.mark.parametrize(
    "turned", ["actual_TCP_force", "ft_raw_wrench", "actual_current_as_torque"]
)
def test_a_sensor_or_a_pull_of_the_wrong_sign_is_suspected(moving, turned):
    model, columns = moving
    for sensor in ("ft_raw_wrench", "actual_current_as_torque"):
        if turned not in (sensor, "actual_TCP_force"):
            continue
        kept = {k: v for k, v in columns.items() if k == sensor or "_q" in k or "pa" in k}
        kept["actual_TCP_force"] = columns["actual_TCP_force"]
        assert findings(truth.log_of(7, **kept), model, FREE) == []
        kept[turned] = -kept[turned]
        (line,) = findings(truth.log_of(7, **kept), model, FREE)
        assert line.startswith(f"{turned} seems to have the wrong sign;")


@pytest.mark.parametrize(
    ("order", "told"),
    [([2, 1, 0], "joint 1 is column _2, joint 3 is column _0"),
     ([1, 2, 0], "joint 1 is column _2, joint 2 is column _0, joint 3 is column _1"),
     ([0, 1, 2], "")],
)  # fmt: skip
def test_commands_in_another_order_of_joints_are_reported(order, told):
    log = with_columns(target_q=(SESSION.q + 0.02)[:, order])
    lines = [line for line in findings(log, MODEL, REGISTERED) if "target_q" in line]
    assert lines == ([f"target_q does not follow actual_q: its joints look out of order: {told}"]
                     if told else [])  # fmt: skip


@pytest.mark.parametrize(
    "command", [0.0, SESSION.q[:1], 1.6 * SESSION.q], ids=("zeros", "frozen", "droop")
)
def test_commands_that_are_far_off_are_in_no_other_order(command):
    """Zeros, a frozen command, and servos that give way (a hobby arm reached 62 %)."""
    log = with_columns(target_q=command + 0 * SESSION.q)
    assert not [line for line in findings(log, MODEL, REGISTERED) if "target_q" in line]


AXES = {
    "those along y, x and z": ([1, 0, 2], [1, 1, 1]),
    "those along -x, y and z": ([0, 1, 2], [-1, 1, 1]),
    "torques before forces": ([3, 4, 5], [1, 1, 1]),
    "": ([1, 0, 2], [1, -1, 1]),  # right-handed: a misalignment
}


@pytest.mark.parametrize("mistake", AXES)
@pytest.mark.parametrize("pulled", [True, False])
def test_left_handed_axes_of_a_force_sensor_are_reported(moving, mistake, pulled):
    """Swapped axes were a misalignment of 2.6 rad, with which the gap was twice as large."""
    model, columns = moving
    order, sign = AXES[mistake]
    axes = [*order, *((np.array(order) + 3) % 6)]
    kept = {k: v for k, v in columns.items() if "torque" not in k}
    kept["ft_raw_wrench"] = kept["ft_raw_wrench"][:, axes] * [*sign, *sign]
    if not pulled:
        alone = Motion.at_rest(kept["actual_q"], Loads(payload_mass=kept["payload"]))
        kept["ft_raw_wrench"] = predict_wrench(model, alone)[:, axes] * [*sign, *sign]
        del kept["actual_TCP_force"], kept["payload_cog"]
    lines = findings(truth.log_of(7, **kept), model, FREE)
    assert [mistake in line for line in lines] == [True] * bool(mistake)


@pytest.mark.parametrize("unit", ["s", "milliseconds", "microseconds", "nanoseconds"])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_times_in_fractions_of_a_second_are_refused(unit: str, start: float):
    """Such a log counted as poses at rest, and its lag as something else."""
    course = truth.course(MODEL.arm.n, 3)
    t = np.arange(300) * 0.02
    scale = {"s": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}[unit]
    log = truth.log_of(
        MODEL.arm.n, timestamp=(t + start) * scale, actual_q=course.at(t, 0),
        actual_qd=course.at(t, 1),
    )  # fmt: skip
    if unit == "s":
        check_units(MODEL, log)
        return
    with pytest.raises(LogError, match=rf"timestamp: .*as in 0\.02 s; the times look like {unit}"):
        check_units(MODEL, log)


@pytest.mark.parametrize("pause", [1.0, 20.0, 1000.0])
def test_rows_far_apart_are_no_other_unit_of_time(pause: float):
    """Single readings of an arm in motion: its way in between says nothing of the speed then."""
    course = truth.course(MODEL.arm.n, 3)
    t = np.arange(300) * pause
    log = truth.log_of(
        MODEL.arm.n, timestamp=t, actual_q=course.at(t, 0), actual_qd=course.at(t, 1)
    )
    check_units(MODEL, log)
