"""Flexibilities are found from poses and loads; intervals are honest, gaps in the data reported."""

import numpy as np
import pytest
from oracle import equilibrium as oracle
from test_equilibrium import SEVEN

from benchmarks.evidence import paper, poses
from benchmarks.evidence.finite_elements import STIFF
from gapbridge.core.arm import arm_from_dh, builtin_rows
from gapbridge.core.effects import flexibility_names
from gapbridge.core.errors import ExcitationError, LogError
from gapbridge.core.estimation import identification
from gapbridge.core.estimation.compliance_fit import fit_nuisances
from gapbridge.core.estimation.flexibilities import prior_of
from gapbridge.core.estimation.held_out import random_folds
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.rotation import rotation_matrix, rotation_vector

DH = {6: builtin_rows("ur10e")["dh"], 7: SEVEN}
TOOL = np.array([0.05, -0.04, 0.2])
NOISE, TURN_NOISE = 2e-5, 1e-4
KNOWN = Metrology(registered=True, sigma=NOISE)


def truth(n, count, seed, noise=NOISE, rotation=True, pull=40.0, still=(), places=None):
    """Return planted flexibilities (2n,) and the columns that other code makes of them."""
    rng = np.random.default_rng(seed)
    planted = rng.uniform(2e-6, 1.5e-5, 2 * n)
    q, mass = rng.uniform(-2, 2, (count, n)), rng.uniform(0, 8, count)
    q[:, list(still)] = 0.7
    q = q if places is None else places
    wrench = rng.normal(size=(count, 6)) * pull * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    cog = np.tile([0.01, 0.0, 0.05], (count, 1))
    position, turn = np.empty((count, 3)), np.empty((count, 3, 3))
    for r in range(count):
        position[r], turn[r] = oracle.solve(oracle.Case(
            DH[n], q[r], planted[:n], planted[n:], TOOL, oracle.Rotation.identity(), mass[r],
            cog[r], wrench[r], np.array([0, 0, -9.80665]),
        ))  # fmt: skip
    jitter = rotation_matrix(rng.normal(size=(count, 3)) * TURN_NOISE * (noise > 0))
    columns = {
        "actual_q": q, "payload": mass, "payload_cog": cog, "actual_TCP_force": wrench,
        "measured_position": position + rng.normal(size=position.shape) * noise,
        "measured_rotation": rotation_vector(jitter @ turn),
    }  # fmt: skip
    if not rotation:
        del columns["measured_rotation"]
    return planted, columns


def model_of(n):
    tool = np.eye(4)
    tool[:3, 3] = TOOL
    return Model(arm_from_dh(DH[n]), tool)


def log_of(n, columns):
    return Log("session.csv", columns, n)


@pytest.mark.parametrize("n", [6, 7])
def test_flexibilities_of_an_independent_truth_are_found_exactly_without_noise(n):
    planted, columns = truth(n, 40, 1, noise=0.0)
    found = identify_compliance(model_of(n), log_of(n, columns), KNOWN)
    np.testing.assert_allclose(np.concatenate([found.axial, found.radial]), planted, rtol=1e-5)
    assert found.identifiable.all()
    assert found.gap_rms > 1e-4
    assert found.remaining_rms < 1e-9
    np.testing.assert_array_equal(found.model.compliance()[0], found.axial)


@pytest.mark.parametrize("n", [6, 7])
@pytest.mark.parametrize("rotation", [False, True])
def test_with_noise_the_residual_is_the_noise_and_held_out_poses_are_met(n, rotation):
    _, columns = truth(n, 80, 2, rotation=rotation)
    found = identify_compliance(model_of(n), log_of(n, columns), KNOWN)
    assert 0.85 * NOISE < found.remaining_rms < 1.15 * NOISE
    assert found.remaining_rms_held_out < 1.2 * NOISE
    assert found.samples == 80


@pytest.mark.slow
def test_errors_of_the_flexibilities_are_as_large_as_their_intervals_say():
    z = []
    for seed in range(8):
        planted, columns = truth(6, 50, 10 + seed)
        found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
        std = np.concatenate([found.std_axial, found.std_radial])
        z.append((np.concatenate([found.axial, found.radial]) - planted) / std)
        np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), std)
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 4


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [1, 3])
def test_intervals_hold_where_joints_are_off_at_all_repeats_of_a_pose(repeats):
    """Rounded or imprecise joints move whole poses, the farther the longer the lever."""
    z = []
    for seed in range(8):
        places = np.random.default_rng(seed).uniform(-2, 2, (60 // repeats, 6))
        planted, columns = truth(6, 60, 40 + seed, rotation=False, places=np.repeat(
            places, repeats, axis=0))  # fmt: skip
        off = np.random.default_rng((seed, 1)).normal(size=places.shape) * 2e-4
        columns["actual_q"] = columns["actual_q"] + np.repeat(off, repeats, axis=0)
        found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
        std = np.concatenate([found.std_axial, found.std_radial])
        off_by = np.concatenate([found.axial, found.radial]) - planted
        z.append((off_by / std)[found.identifiable])
    assert 0.7 < np.sqrt(np.mean(np.square(np.concatenate(z)))) < 1.2


def test_intervals_of_few_poses_count_the_frame_and_tool_point_that_are_fitted_too():
    """What is fitted to ten poses leaves gaps a good deal smaller than the noise."""
    z = []
    for seed in range(16):
        planted, columns = truth(6, 10, 70 + seed, rotation=False)
        found = identify_compliance(model_of(6), log_of(6, columns), Metrology(registered=False))
        std = np.concatenate([found.std_axial, found.std_radial])
        values = np.concatenate([found.axial, found.radial])
        free = found.identifiable & (values > 0)
        z.append(((values - planted) / std)[free])
    assert 0.7 < np.sqrt(np.mean(np.square(np.concatenate(z)))) < 1.3


def test_a_frame_that_nobody_registered_is_found_along():
    planted, columns = truth(6, 60, 3, noise=0.0)
    turn, shift = rotation_matrix(np.array([0.4, -1.0, 2.0])), np.array([1.0, -2.0, 0.5])
    columns["measured_position"] = columns["measured_position"] @ turn.T + shift
    columns["measured_rotation"] = rotation_vector(
        turn @ rotation_matrix(columns["measured_rotation"])
    )
    found = identify_compliance(model_of(6), log_of(6, columns), Metrology(registered=False))
    np.testing.assert_allclose(found.registration.rotation, turn, atol=1e-7)
    np.testing.assert_allclose(found.registration.position, shift, atol=1e-7)
    np.testing.assert_allclose(np.concatenate([found.axial, found.radial]), planted, rtol=1e-3)


def test_outlier_readings_are_named_and_do_not_count():
    planted, columns = truth(6, 60, 4)
    outlier = [7, 23, 41]
    columns["measured_position"][outlier] += [0.003, -0.002, 0.004]
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    assert found.outliers.tolist() == outlier
    assert Note(Reason.OUTLIERS, (3,)) in found.notes
    assert found.remaining_rms < 1.2 * NOISE
    std = np.concatenate([found.std_axial, found.std_radial])
    assert (np.abs(np.concatenate([found.axial, found.radial]) - planted) < 5 * std).all()


def test_rows_without_a_measurement_are_left_out_and_keep_their_number():
    _, columns = truth(6, 60, 5)
    columns["measured_position"][[3, 11]] = np.nan
    columns["measured_position"][20] += 0.01
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    assert found.samples == 58
    assert found.outliers.tolist() == [20]


def test_what_the_data_do_not_show_is_named():
    # a vertical first joint carries no torque by weight, and no pull is in the log
    _, columns = truth(6, 40, 6, noise=0.0, rotation=False, pull=0.0)
    del columns["actual_TCP_force"]
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    assert not found.identifiable[0]
    assert Note(Reason.HELD, ("axial_compliance_1",)) in found.combinations
    assert found.identifiable[1:3].all()


@pytest.mark.parametrize("own", [0.0, 6e-6])
def test_what_the_data_do_not_show_stays_exactly_at_the_models_value(own):
    # by weight alone a vertical first joint does not twist, and the TCP is on the last axis
    _, columns = truth(6, 40, 6, rotation=False, pull=0.0)
    del columns["actual_TCP_force"]
    model = model_of(6).with_compliance([own] * 6, [own] * 6)
    found = identify_compliance(model, log_of(6, columns), KNOWN)
    values = np.concatenate([found.axial, found.radial])
    held = np.flatnonzero(~found.identifiable)
    assert 0 in held
    assert len(held) < 6
    np.testing.assert_array_equal(values[held], own)
    assert (values[found.identifiable] != own).sum() > 6
    for i in held:
        reported = [
            note for note in found.combinations if note.values[0] == flexibility_names(6)[i]
        ]
        assert len(reported) == 1
        assert reported[0].reason in (Reason.HELD, Reason.ACTS_LIKE)


def test_of_a_sum_that_is_known_alone_one_member_carries_the_whole():
    # as above, with an instrument too coarse to separate the shoulder's give from the base's tilt
    planted, columns = truth(6, 40, 7, noise=2e-3, rotation=False, pull=0.0, still=(1, 2))
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    both = found.identifiable[[1, 6]]
    assert both.sum() == 1
    carrier = np.array([1, 6])[both][0]
    value, std = (
        np.concatenate([found.axial, found.radial])[carrier],
        np.concatenate([found.std_axial, found.std_radial])[carrier],
    )
    assert abs(value - planted[1] - planted[6]) < 4 * std
    other = flexibility_names(6)[np.array([1, 6])[~both][0]]
    reported = next(note for note in found.combinations if note.values[0] == other)
    assert reported.reason is Reason.ACTS_LIKE
    assert flexibility_names(6)[carrier] in [part for _, part in reported.values[1]]


def test_a_tool_point_that_nobody_registered_is_found_along_and_costs_no_flexibility():
    planted, columns = truth(6, 60, 3, noise=0.0)
    shift = np.array([0.03, -0.02, 0.11])
    turn = rotation_matrix(columns["measured_rotation"])
    del columns["measured_rotation"]
    columns["measured_position"] = columns["measured_position"] + turn @ shift
    columns["actual_TCP_force"][:] = 0.0  # a pull acts at the tool point, wherever that is
    q, loads = columns["actual_q"], Loads(columns["payload"], columns["payload_cog"])
    deflected = model_of(6).with_compliance(planted[:6], planted[6:]).predict(q, loads)
    columns["measured_position"] = deflected.position + deflected.rotation @ shift
    log = log_of(6, columns)
    found = identify_compliance(model_of(6), log, Metrology(registered=False))
    np.testing.assert_allclose(found.tool_offset, shift, atol=1e-6)
    values = np.concatenate([found.axial, found.radial])
    np.testing.assert_allclose(values[[1, 2, 3, 4, 7, 8, 9]], planted[[1, 2, 3, 4, 7, 8, 9]],
                               rtol=1e-3)  # fmt: skip
    assert found.remaining_rms < 1e-8
    assert Note(Reason.NOTHING_WRITTEN) in found.notes
    known = identify_compliance(model_of(6), log, KNOWN)
    assert not known.tool_determined  # 116 mm: a target that sits elsewhere, and no TCP to write
    assert known.remaining_rms > 1e-2


@pytest.mark.parametrize("metrology", [KNOWN, Metrology(sigma=NOISE)])
def test_before_and_after_are_counted_alike(metrology):
    # a model that is right already gains nothing, on seen and on unseen poses, outliers left out
    planted, columns = truth(6, 60, 5, rotation=False)
    columns["measured_position"][[4, 33]] += [0.004, -0.003, 0.002]
    right = model_of(6).with_compliance(planted[:6], planted[6:])
    found = identify_compliance(right, log_of(6, columns), metrology)
    assert found.outliers.tolist() == [4, 33]
    assert 0.85 * NOISE < found.gap_rms < 1.15 * NOISE
    assert found.remaining_rms == pytest.approx(found.gap_rms, rel=0.05)
    assert found.gap_rms_held_out < found.remaining_rms_held_out < 1.3 * found.gap_rms_held_out


def test_two_flexibilities_that_act_alike_are_reported_as_one_combination():
    # where shoulder and elbow never turn, the base's tilt and the shoulder's give look the same
    planted, columns = truth(6, 40, 7, rotation=False, pull=0.0, still=(1, 2))
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    reported = [note for note in found.combinations if note.reason is Reason.SUM_KNOWN]
    assert reported[0].values[:2] == ("axial_compliance_2", "radial_compliance_1")
    both = found.axial[1] + found.radial[0]
    of_both = found.covariance[np.ix_([1, 6], [1, 6])].sum() ** 0.5
    assert of_both < 0.3 * found.std_axial[1]
    assert abs(both - planted[1] - planted[6]) < 5 * of_both


def test_one_pose_shows_too_little_for_a_held_out_figure():
    _, columns = truth(6, 12, 7, still=range(6))
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    assert np.isnan(found.remaining_rms_held_out)
    assert found.remaining_rms < 2 * NOISE


@pytest.mark.parametrize("repeats", [40, 110])
def test_repeats_of_a_pose_leave_together_also_in_a_long_log(monkeypatch, repeats):
    """A fit that saw a repeat of the judged pose would have fitted its noise."""
    seen = []

    def drawn(groups):
        seen.append(len(np.unique(groups)))
        return random_folds(groups)

    monkeypatch.setattr(identification, "random_folds", drawn)
    _, columns = truth(6, 30, 8, rotation=False)
    many = {k: np.repeat(v, repeats, axis=0) for k, v in columns.items()}
    data, _ = identification.data_of(log_of(6, many), KNOWN)
    settings = identification._FitSettings(prior_of(model_of(6)), rounds=1)
    fit = fit_nuisances(model_of(6), data)
    identification._held_out_rms(data, settings, (fit, fit), np.ones(len(data.q), dtype=bool))
    assert seen == [30]


def test_flexibilities_stay_at_or_above_zero():
    planted, columns = truth(6, 50, 8)
    planted[[3, 9]] = 0.0
    q, n = columns["actual_q"], 6
    loads = Loads(columns["payload"], columns["payload_cog"], columns["actual_TCP_force"])
    deflected = model_of(6).with_compliance(planted[:n], planted[n:]).predict(q, loads)
    del columns["measured_rotation"]
    held = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        columns["measured_position"] = deflected.position + rng.normal(size=(50, 3)) * NOISE
        bound = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
        values = np.concatenate([bound.axial, bound.radial])
        assert ((values == 0) | (values > 1e-9)).all()  # at the bound exactly, or a value
        held += int((values[[3, 9]] == 0).sum())
    assert held > 0


def test_a_fit_starts_from_the_flexibilities_that_are_in_the_model():
    planted, columns = truth(6, 40, 9, noise=0.0)
    near = model_of(6).with_compliance(1.2 * planted[:6], 0.7 * planted[6:])
    found = identify_compliance(near, log_of(6, columns), KNOWN)
    np.testing.assert_allclose(np.concatenate([found.axial, found.radial]), planted, rtol=1e-5)


def test_a_log_that_excites_nothing_is_declined_with_the_reason():
    weightless = [{k: v for k, v in row.items() if k not in ("mass", "cog")} for row in DH[6]]
    model = Model(arm_from_dh(weightless))
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    columns = {"actual_q": q, "measured_position": model.rigid_pose(q).position}
    with pytest.raises(ExcitationError, match="links have no mass in the cell, and no payload"):
        identify_compliance(model, log_of(6, columns))


def test_too_few_rows_and_missing_columns_are_reported():
    _, columns = truth(6, 4, 10)
    few = {k: v[:2] for k, v in columns.items()}
    with pytest.raises(ExcitationError, match=r"found 2 row\(s\).*expected at least 4"):
        identify_compliance(model_of(6), log_of(6, few), Metrology(registered=False))
    with pytest.raises(LogError, match=r"found no measured_position_0\.\.2"):
        identify_compliance(model_of(6), log_of(6, {"actual_q": columns["actual_q"]}))
    del columns["actual_q"]
    with pytest.raises(LogError, match=r"found no actual_q_0\.\.5 or target_q_0\.\.5"):
        identify_compliance(model_of(6), log_of(6, columns))


def test_a_fit_that_leaves_nothing_to_judge_it_by_is_declined():
    """One pose in base bends three flexibilities as it likes; its spread would be zero."""
    _, columns = truth(6, 4, 10)
    for rows in (1, 2):
        few = {k: v[:rows] for k, v in columns.items()}
        with pytest.raises(ExcitationError, match=rf"found {rows} row\(s\).*expected more poses"):
            identify_compliance(model_of(6), log_of(6, few), KNOWN)


@pytest.mark.parametrize(("poses", "fits"), [(1, False), (2, False), (3, True)])
def test_a_frame_that_nobody_registered_takes_three_poses(poses, fits):
    """Under other loads too: a fit to fewer poses ended with a tool point metres away."""
    places = np.random.default_rng(3).uniform(-2, 2, (poses, 6))[np.arange(24) % poses]
    _, columns = truth(6, 24, 7, rotation=False, places=places)
    if fits:
        found = identify_compliance(model_of(6), log_of(6, columns), Metrology(sigma=NOISE))
        assert found.remaining_rms < 2 * NOISE
        return
    match = rf"{poses} different pose\(s\) on one line.*metrology\.registered: true"
    with pytest.raises(ExcitationError, match=match):
        identify_compliance(model_of(6), log_of(6, columns), Metrology(sigma=NOISE))
    identify_compliance(model_of(6), log_of(6, columns), KNOWN)


@pytest.mark.parametrize(("rows", "registered"), [(1, True), (2, True), (1, False), (3, False)])
def test_rows_that_are_copies_of_each_other_are_no_poses_more(rows, registered):
    _, columns = truth(6, 4, 10)
    copies = {k: np.repeat(v[:rows], 40, axis=0) for k, v in columns.items()}
    found = rf"found {40 * rows} row\(s\) with measured positions of {rows} different pose"
    with pytest.raises(ExcitationError, match=found):
        identify_compliance(model_of(6), log_of(6, copies), Metrology(registered=registered))


@pytest.mark.parametrize("name", ["ur10e", "seven"])
@pytest.mark.parametrize("links", [STIFF, paper.TUBE])
def test_the_papers_experiment_holds_against_finite_elements(name, links):
    for seed in (1, 2):
        errors, _, _ = paper.linear_fit(paper.experiment(name, seed, links, torque=0.0))
        assert np.nanmax(np.abs(errors[: paper.FIT])) < 0.0025e-2
        assert np.nanmax(np.abs(errors[paper.FIT :])) < 0.004e-2


@pytest.mark.parametrize("name", ["ur10e", "seven"])
def test_the_linear_form_predicts_finite_elements_from_the_true_flexibilities(name):
    case = paper.experiment(name, 3, STIFF, paper.TORQUE)
    arm = paper.frame_arm(name, np.random.default_rng(3))
    q = np.tile(case.q, (len(case.wrench), 1))
    A = case.model.linear_form(q, Loads(wrench=case.wrench)).regressor
    linear = A @ np.concatenate([arm.axial, arm.radial])
    for part in (slice(3), slice(3, 6)):
        scale = np.abs(case.deflection[:, part]).max()
        np.testing.assert_allclose(linear[:, part], case.deflection[:, part], atol=1e-4 * scale)


@pytest.mark.slow
def test_fifty_noisy_poses_foretell_fifty_others_of_finite_elements_to_the_noise():
    columns = poses.measured(paper.frame_arm("ur10e", np.random.default_rng(1)),
                             np.random.default_rng(1), "ur10e")  # fmt: skip
    for registered in (True, False):
        found = poses.emit("ur10e", columns, 1, registered)
        rest = slice(poses.POSES, None)
        loads = Loads(columns["payload"], columns["payload_cog"], columns["actual_TCP_force"])[rest]
        predicted = found.model.predict(columns["actual_q"][rest], loads).position
        if registered:
            gap = predicted - columns["measured_position"][rest]
            # what the model is off from the truth, the noise of a reading beside it
            assert np.sqrt(np.mean(gap**2) + poses.NOISE**2) < 1.2 * poses.NOISE
        assert found.remaining_rms_held_out < 1.2 * poses.NOISE


def test_a_wrong_height_of_the_base_makes_no_row_an_outlier():
    """It is in one coordinate of three, whose median shows nothing; all rows were left out."""
    columns = truth(6, 40, 5, rotation=False)[1]
    columns["measured_position"][:, 2] += 0.02
    found = identify_compliance(model_of(6), log_of(6, columns), KNOWN)
    assert len(found.outliers) == 0
    assert found.remaining_rms > 2e-3
