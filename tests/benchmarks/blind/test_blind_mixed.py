import csv

import numpy as np
import pytest
from blind_answers import answer, cause, true_causes
from further import further

from benchmarks.blind.beyond import true_beyond
from benchmarks.blind.cases import drawn_case, make_case
from benchmarks.blind.remainders import REMAINDERS
from benchmarks.blind.score import score

SEED = 1


@pytest.fixture(scope="module")
def label(tmp_path_factory):
    return make_case("mixed:1", SEED, tmp_path_factory.mktemp("mixed"))


def test_all_known_effects_and_the_remainder_admitted_is_right(label):
    s = score(label, answer(label, true_causes(label), structured=True))
    assert s.outcome == "right"
    assert (s.known, s.known_named) == (1, 1)
    assert all(abs(z) < 1 for z in s.z.values()) and s.z


def test_a_remainder_that_is_passed_over_is_no_right_answer(label):
    s = score(label, answer(label, true_causes(label), structured=False))
    assert s.outcome == "unadmitted"
    assert not s.ok


def test_to_accuse_nothing_beside_a_remainder_is_to_miss_the_known_effect(label):
    s = score(label, answer(label, structured=True))
    assert (s.outcome, s.known_named, s.false) == ("abstained", 0, ())


def test_a_false_accusation_beside_a_true_one_is_false(label):
    bad = cause("thermal_drift", (), [("thermal_drift", 1e-5, 1e-7)])
    s = score(label, answer(label, [*true_causes(label), bad], structured=True))
    assert s.outcome == "wrong"
    assert s.false == ("thermal_drift",)
    assert s.known_named == 1


def test_the_first_order_of_the_remainder_may_be_accused(label):
    assert label.akin
    kin = [cause(e, () if j is None else (j,)) for e, j in label.akin]
    s = score(label, answer(label, [*true_causes(label), *kin], structured=True))
    assert s.outcome == "right"


def test_the_remainder_of_a_region_not_shown_is_what_the_model_leaves_there(label):
    none, known = true_beyond(label, []), true_beyond(label, true_causes(label))
    assert none > known > label.floor_rms
    reported = answer(label, true_causes(label), structured=True)
    reported["channels"][0]["remaining_rms_new_region"] = known
    s = score(label, reported)
    assert s.reported_beyond == pytest.approx(s.true_beyond)


def test_whole_regions_of_joint_space_are_kept_back(label):
    bench = drawn_case(label.kind, label.seed)[0].drawn.bench
    assert len(bench.fresh.q) >= 12
    scale = np.std(bench.session.q, axis=0)
    seen, away = bench.session.q / scale, bench.fresh.q / scale

    def nearest(a, b):
        return np.sort(np.linalg.norm(a[:, None] - b, axis=2), axis=1)

    # a pose kept back has others of its own kind nearer than the poses of the log have such
    assert np.median(nearest(away, away)[:, 1]) < np.median(nearest(away, seen)[:, 0])


@pytest.mark.parametrize("name", ["bent_tool", *further("bump")])
def test_a_remainder_leaves_no_known_effect_in_its_own_place(name, tmp_path):
    label = make_case(f"mixed:{name}", SEED, tmp_path)
    assert name in REMAINDERS
    places = {(c.effect, j) for c in label.causes for j in c.joints or (None,)}
    assert not places & set(label.akin)
    assert label.depends_on


def test_two_sessions_are_read_from_two_places(tmp_path):
    label = make_case("sessions:one", SEED, tmp_path)
    with (tmp_path / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    session = np.array([float(r["session"]) for r in rows])
    assert set(session) == {0.0, 1.0}
    bench = drawn_case(label.kind, label.seed)[0].drawn.bench
    assert not bench.instrument.registered
    assert bench.frame().shape[1] == 12


def test_doubled_rows_are_the_same_reading_twice(tmp_path):
    make_case("laid_out:doubled", SEED, tmp_path)
    with (tmp_path / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 70
    assert all(a["measured_position_0"] == b["measured_position_0"]
               for a, b in zip(rows[::2], rows[1::2], strict=True))  # fmt: skip
