import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from benchmarks.blind.__main__ import main
from benchmarks.blind.cases import effects_of, group_of, kinds, make_case
from benchmarks.blind.draws import POSITION_EFFECTS
from benchmarks.blind.run import Command, DiagnosisError, Job, jobs_of, run_blind, run_job

ALL = [k for own in kinds().values() for k in own if not k.startswith(("withheld:", "torque:"))]


def read(folder):
    with (folder / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.reader(file))
    return rows[0], np.array(rows[1:], dtype=float)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_every_kind_can_be_drawn_and_its_folder_shows_nothing(kind, tmp_path):
    label = make_case(kind, 11, tmp_path)
    names = {p.name for p in tmp_path.iterdir()}
    assert {"log.csv", "cell.yaml"} <= names <= {"log.csv", "cell.yaml", "robot.urdf"}
    cell = (tmp_path / "cell.yaml").read_text(encoding="utf-8")
    head, values = read(tmp_path)
    effects = {*label.effects, label.outside, *POSITION_EFFECTS} - {None, "payload", "payload_cog"}
    for word in effects:
        assert word not in cell
        assert not any(word in name for name in head)
    assert np.isfinite(values).all()
    assert (np.diff(values[:, head.index("timestamp")]) > 0).all()
    assert group_of(kind) in kinds()


def test_a_torque_case_holds_thirty_seconds_of_all_joints(tmp_path):
    pytest.importorskip("pinocchio")
    label = make_case("torque:viscous_friction", 1, tmp_path)
    head, values = read(tmp_path)
    n = sum(name.startswith("actual_current_as_torque_") for name in head)
    assert n == sum(name.startswith("actual_q_") for name in head)
    assert values[-1, 0] == pytest.approx(30.0, abs=0.01)
    assert label.causes[0].effect == "viscous_friction"


def test_a_case_can_be_drawn_again_and_another_seed_is_another_case(tmp_path):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        make_case("pair", seed, tmp_path / name)
    a, b, c = ((tmp_path / n / "log.csv").read_bytes() for n in "abc")
    assert a == b
    assert a != c


def test_a_withheld_case_has_the_data_of_the_plain_one(tmp_path):
    plain = make_case("radial_compliance", 3, tmp_path / "plain")
    withheld = make_case("withheld:radial_compliance", 3, tmp_path / "withheld")
    logs = [(tmp_path / n / "log.csv").read_bytes() for n in ("plain", "withheld")]
    assert logs[0] == logs[1]
    assert plain.withhold == ()
    assert withheld.withhold == ("radial_compliance",)


def test_the_cell_holds_the_drawing_and_not_the_truth(tmp_path):
    label = make_case("joint_offset", 4, tmp_path)
    cell = yaml.safe_load((tmp_path / "cell.yaml").read_text(encoding="utf-8"))
    assert set(cell) <= {
        "robot", "tool", "payload", "gravity", "reference_temperature", "compliance", "metrology",
    }  # fmt: skip
    if "dh" in cell["robot"]:
        value = next(iter(label.causes[0].parameters.values()))
        assert all(abs(row["offset"] - value) > 1e-9 for row in cell["robot"]["dh"])


def test_the_noise_of_clean_data_is_the_floor_of_the_label(tmp_path):
    ratios = []
    for seed in range(30):
        label = make_case("none", seed, tmp_path)
        assert label.gap_rms == 0
        cell = yaml.safe_load((tmp_path / "cell.yaml").read_text(encoding="utf-8"))
        if not cell["metrology"]["registered"]:
            continue
        from benchmarks.blind.cases import draw_case, generator_of

        head, values = read(tmp_path)
        measured = values[:, [head.index(f"measured_position_{k}") for k in range(3)]]
        model = draw_case("none", generator_of("none", seed)).drawn.bench.model
        ratios.append(np.sqrt(np.mean((measured - model.tcp) ** 2)) / label.floor_rms)
    assert len(ratios) > 8
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.04)


def test_hard_data_hold_outlier_readings(tmp_path):
    from benchmarks.blind.cases import draw_case, generator_of
    from benchmarks.blind.special_cases import with_outliers

    drawn = draw_case("hard:none", generator_of("hard:none", 0)).drawn
    position, _ = with_outliers(drawn, np.random.default_rng(1))
    instrument = drawn.bench.instrument
    truth = drawn.bench.model.tcp @ instrument.rotation.T + instrument.position
    off = np.linalg.norm(position - truth, axis=1)
    assert len(off) == 30
    assert (off > 1e-3).sum() == 1


def test_an_unknown_kind_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match="backlush"):
        make_case("backlush", 1, tmp_path)
    with pytest.raises(ValueError, match="backlush"):
        list(run_blind(1, ["backlush"]))


def test_pairs_never_hold_a_joint_stiffness_twice():
    rng = np.random.default_rng(0)
    for _ in range(300):
        drawn = set(effects_of("triple", rng))
        assert not {"axial_compliance", "stiffness_nonlinearity"} <= drawn
        assert len(drawn) == 3


def test_clean_cases_come_in_larger_number():
    jobs = jobs_of(["none", "backlash"], 20, 100)
    assert sum(j.kind == "none" for j in jobs) == 200
    assert [j.seed for j in jobs if j.kind == "backlash"] == list(range(100, 120))


def blame_nobody(log, cell, withhold):
    assert sorted(p.name for p in log.parent.iterdir())[:2] == ["cell.yaml", "log.csv"]
    channel = {"channel": "position", "causes": [], "unexplained": {"structured": False}}
    return {"channels": [channel]}


def test_a_run_yields_a_score_a_case_also_with_several_processes():
    scores = list(run_blind(2, ["backlash", "hard:none"], 2, None, blame_nobody, 7))
    assert sorted((s.kind, s.seed, s.outcome) for s in scores) == [
        ("backlash", 7, "abstained"), ("backlash", 8, "abstained"),
        ("hard:none", 7, "right"), ("hard:none", 8, "right"),
    ]  # fmt: skip


def test_a_diagnosis_that_breaks_is_a_failed_case_not_the_end_of_the_run():
    def broken(log, cell, withhold):
        raise DiagnosisError("exit 2: no")

    got = run_job(Job("none", 1), broken)
    assert (got.outcome, got.message) == ("failed", "DiagnosisError: exit 2: no")


def test_a_command_is_given_log_cell_and_what_is_withheld(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "import json, sys\n"
        "words = sys.argv[1:]\n"
        "json.dump({'words': words}, open(words[words.index('--json') + 1], 'w'))\n",
        encoding="utf-8",
    )
    command = Command.parse(f"python3 {program} diagnose")
    got = command(tmp_path / "log.csv", tmp_path / "cell.yaml", ("backlash",))
    words = got["words"]
    assert words[:4] == ["diagnose", str(tmp_path / "log.csv"), "--cell", f"{tmp_path}/cell.yaml"]
    assert words[-2:] == ["--withhold", "backlash"]
    program.write_text("import sys\nsys.exit('what went wrong')\n", encoding="utf-8")
    with pytest.raises(DiagnosisError, match="what went wrong"):
        command(tmp_path / "log.csv", tmp_path / "cell.yaml", ())


def test_diagnoses_are_kept_where_asked(tmp_path):
    run_job(Job("none", 1), blame_nobody, tmp_path)
    kept = json.loads((tmp_path / "none-1.json").read_text(encoding="utf-8"))
    assert kept["channels"][0]["causes"] == []


def test_a_diagnosis_that_never_ends_is_cut_off(monkeypatch):
    import time

    from benchmarks.blind import run

    monkeypatch.setattr(run, "LIMIT", 0.1)
    got = run_job(Job("none", 1), lambda log, cell, withhold: time.sleep(20))
    assert (got.outcome, got.message) == ("failed", "DiagnosisError: no answer in 0.1 s")


def test_an_effect_of_wanted_size_has_that_size(tmp_path):
    label = make_case("size:axial_compliance@0.8", 3, tmp_path)
    assert label.gap_rms / label.floor_rms == pytest.approx(0.8, rel=1e-3)
    assert len(label.causes[0].joints) == 1


def test_the_cramer_rao_bound_of_an_offset_is_that_of_its_only_number():
    from benchmarks.blind.sensitivity import SURE, cramer_rao

    # one number, 70 poses of 3 coordinates: its deviation is gap / (floor sqrt(210)), where
    # rotations are not measured too
    assert 0.5 * SURE / np.sqrt(210) < cramer_rao("joint_offset", range(8)) < 1.02 * SURE / 210**0.5


def test_the_command_is_found_without_an_activated_environment(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    first = Path(Command.parse("gapbridge diagnose").command[0])
    assert first.parent == Path(sys.executable).parent
    assert Command.parse("./mine diagnose").command == ("./mine", "diagnose")


@pytest.mark.parametrize(
    ("options", "phrase"),
    [
        (["--command", "/nonexistent diagnose"], "found no program '/nonexistent'"),
        (["--out", "{}/file"], "file: found a file, expected a folder for --out"),
        (["--out", "{}/taken"], "blind.html: found a folder"),
    ],
)
def test_what_cannot_be_run_or_written_is_refused_before_the_first_case(options, phrase, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "blind.html").mkdir(parents=True)
    result = CliRunner().invoke(main, [option.format(tmp_path) for option in options])
    assert result.exit_code == 2
    assert phrase in result.output
    assert "first seed" not in result.output
