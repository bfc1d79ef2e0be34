import numpy as np
import pytest
from blind_answers import answer, cause, true_causes

from benchmarks.blind.cases import make_case
from benchmarks.blind.hidden import Hidden
from benchmarks.blind.score import score


@pytest.fixture
def case(tmp_path):
    return lambda kind, seed=1: make_case(kind, seed, tmp_path)


def test_the_true_cause_with_its_joints_and_values_is_right(case):
    label = case("axial_compliance")
    got = score(label, answer(label, true_causes(label, off=2.0)))
    assert (got.outcome, got.joints_right, got.false) == ("right", True, ())
    assert list(got.z.values()) == pytest.approx([2.0] * len(got.z))
    assert got.remainder == pytest.approx(1.0)


def test_the_right_effect_at_the_wrong_joint_is_separated(case):
    label = case("joint_offset", 2)
    joint = label.causes[0].joints[0]
    other = joint - 1 if joint > 2 else joint + 1
    got = score(label, answer(label, [cause("joint_offset", [other])]))
    assert got.outcome == "right"
    assert got.joints_right is False
    assert got.z == {}


def test_one_joint_too_many_is_a_wrong_joint(case):
    label = case("backlash")
    named = sorted({*label.causes[0].joints, 1, 2, 3, 4})
    got = score(label, answer(label, [cause("backlash", named)]))
    assert got.joints_right is False


def test_another_cause_is_a_false_accusation(case):
    label = case("thermal_drift")
    got = score(label, answer(label, [cause("backlash", [2])]))
    assert (got.outcome, got.false) == ("wrong", ("backlash",))


def test_a_cause_too_many_is_a_false_accusation(case):
    label = case("tool_frame")
    got = score(label, answer(label, [*true_causes(label), cause("payload")]))
    assert (got.outcome, got.false) == ("wrong", ("payload",))


def isotropic_base(case):
    for seed in range(60):
        label = case("base_compliance", seed)
        x, y = label.causes[0].parameters.values()
        if x == y:
            return label
    raise AssertionError("no isotropic base in 60 draws")


def test_a_true_twin_with_the_tie_reported_is_right(case):
    label = isotropic_base(case)
    twin = cause("radial_compliance", [1], ties=["base_compliance"])
    assert score(label, answer(label, [twin])).outcome == "right_tie"


def test_a_true_twin_without_a_word_of_the_tie_is_not(case):
    label = isotropic_base(case)
    got = score(label, answer(label, [cause("radial_compliance", [1])]))
    assert (got.outcome, got.ok) == ("tie_untold", False)


@pytest.mark.parametrize(("ties", "outcome"), [(["radial_compliance"], "right_tie"), ([], "wrong")])
def test_a_twin_at_one_of_several_joints_is_right_with_the_tie_reported(case, ties, outcome):
    labels = (case("radial_compliance", seed) for seed in range(60))
    label = next(x for x in labels if x.causes[0].joints[0] == 1 and len(x.causes[0].joints) > 1)
    rest = cause("radial_compliance", label.causes[0].joints[1:])
    got = score(label, answer(label, [rest, cause("base_compliance", ties=ties)]))
    assert got.outcome == outcome


def test_a_tie_with_what_the_data_rule_out_does_not_help(case):
    label = case("thermal_drift")
    got = score(label, answer(label, [cause("backlash", [2], ties=["thermal_drift"])]))
    assert got.outcome == "wrong"


def test_a_needless_tie_beside_the_truth_is_counted(case):
    label = case("thermal_drift")
    truth = true_causes(label)
    truth[0]["indistinguishable_from"] = ["gravity_direction"]
    got = score(label, answer(label, truth))
    assert got.outcome == "right"
    assert got.needless_ties == ("thermal_drift~gravity_direction",)


def test_clean_data_is_right_only_without_accusation_and_structure(case):
    label = case("none")
    assert score(label, answer(label)).outcome == "right"
    assert score(label, answer(label, structured=True)).outcome == "wrong"
    got = score(label, answer(label, [cause("joint_offset", [3])]))
    assert (got.outcome, got.false) == ("wrong", ("joint_offset",))


def test_an_effect_outside_the_catalogue_must_be_reported_as_unexplained(case):
    label = case("outside:tool_plate")
    reported = score(label, answer(label, structured=True, depends=["actual_q_0", "payload"]))
    assert (reported.outcome, reported.depends_right) == ("right", True)
    assert score(label, answer(label)).outcome == "missed"
    blamed = score(label, answer(label, [cause("payload")], structured=True))
    assert (blamed.outcome, blamed.false) == ("wrong", ("payload",))


@pytest.mark.slow
def test_what_it_depends_on_counts_among_the_first_three_only(case):
    label = case("outside:tool_plate")
    reported = ["actual_q_0", "actual_q_1", "actual_q_2", "payload"]
    assert score(label, answer(label, structured=True, depends=reported)).depends_right is False


def test_a_withheld_effect_must_be_reported_as_unexplained_too(case):
    label = case("withheld:backlash")
    assert label.withhold == ("backlash",)
    joint = label.causes[0].joints[0]
    reported = [f"approach_{joint - 1}"]
    got = score(label, answer(label, structured=True, depends=reported))
    assert (got.outcome, got.depends_right) == ("right", True)


def test_what_a_withheld_effect_depends_on_is_found_by_shuffling(case):
    label = case("withheld:axial_compliance", 2)
    reported = answer(label, structured=True, depends=["joint_temperatures_1", "approach_2"])
    assert score(label, reported).depends_right is False
    reported = answer(label, structured=True, depends=["approach_2", "actual_q_1", "actual_q_2"])
    assert score(label, reported).depends_right is True


@pytest.mark.slow
def test_a_twin_may_be_named_for_a_withheld_effect(tmp_path):
    for seed in range(60):
        label = make_case("withheld:base_compliance", seed, tmp_path)
        x, y = label.causes[0].parameters.values()
        if x == y:
            break
    got = score(label, answer(label, [cause("radial_compliance", [1])]))
    assert got.outcome == "right_tie"


@pytest.mark.slow
def test_the_first_order_of_a_withheld_effect_may_be_named_with_the_rest_admitted(tmp_path):
    label = make_case("withheld:torque:load_friction", 3, tmp_path)
    own = [cause("coulomb_friction", [j]) for j in label.causes[0].joints]
    assert score(label, answer(label, own, structured=True)).outcome == "first_order"
    assert score(label, answer(label, own)).outcome == "wrong"
    others = set(range(1, 7)) - set(label.causes[0].joints)
    elsewhere = [cause("coulomb_friction", [j]) for j in sorted(others)]
    assert score(label, answer(label, elsewhere, structured=True)).outcome == "wrong"


def test_play_that_is_never_reversed_is_an_offset_as_long_as_the_tie_is_reported(case):
    label = case("bad:no_reversals")
    joints = label.causes[0].joints
    reported = cause("joint_offset", joints, ties=["backlash"])
    assert score(label, answer(label, [reported])).outcome == "right_tie"
    assert score(label, answer(label)).outcome == "abstained"


def test_a_diagnosis_without_the_channel_failed(case):
    label = case("none")
    assert score(label, {"channels": []}).outcome == "failed"


@pytest.mark.parametrize("kind", ["wrench:ft_gain", "tracking:latency", "wrench:pair"])
def test_other_channels_are_scored_alike(case, kind):
    label = case(kind)
    got = score(label, answer(label, true_causes(label)))
    assert (got.outcome, got.joints_right) == ("right", True)
    if kind == "tracking:latency":
        blamed = score(label, answer(label, [cause("tracking_lag", [1], ties=["latency"])]))
        assert blamed.outcome == "wrong"


@pytest.mark.slow
def test_a_delay_of_the_whole_arm_may_be_reported_joint_by_joint_or_of_the_arm(tmp_path):
    for seed in range(10):
        label = make_case("tracking:latency", seed, tmp_path)
        if len(label.causes[0].joints) >= 6:
            break
    whole = score(label, answer(label, [cause("latency")]))
    assert (whole.outcome, whole.joints_right) == ("right", True)
    assert score(label, answer(label, true_causes(label))).joints_right is True


@pytest.mark.parametrize(("rows", "right"), [(0.5, True), (1.0, True), (3.0, False)])
def test_the_moment_of_a_slip_is_right_within_one_row(case, rows, right):
    label = case("target_slip")
    time = np.sort(Hidden(label.kind, label.seed).case.drawn.bench.session.time)
    causes = true_causes(label)
    (moment,) = (p for p in causes[0]["parameters"] if p["name"].endswith("_time"))
    after = np.searchsorted(time, moment["value"])
    place = np.arange(len(time))
    moment["value"] = float(np.interp(after - 0.5 + rows, place, time))
    got = score(label, answer(label, causes))
    assert got.moments == (right,)
    assert score(label, answer(label, [])).moments == ()
