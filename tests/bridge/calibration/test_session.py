"""Sessions run by the command: mistakes and their correction, interruptions, refusals."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripted_session import (
    AXIAL,
    FRAME,
    KNOCKED,
    CommandResult,
    plan_in,
    reading_line,
    run_calibrate,
    session_lines,
    tracker_readings,
    truth,
    write_cell,
)

from gapbridge.bridge.calibration.jobs import calibrate as calibrate_module
from gapbridge.bridge.calibration.jobs import verify as verify_module
from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.verification_mark import read_mark, write_mark
from gapbridge.core.errors import RunError

GAUGE = "{kind: dial_gauge, unit: mm}\n  instrument_at: [1, 0, 1]"


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CommandResult]:
    """Return the folder and the result of a session without mistakes."""
    folder = tmp_path_factory.mktemp("clean")
    cell = write_cell(folder)
    assert run_calibrate(cell, "--plan-only", "--session", folder / "s").code == 0
    plan = plan_in(folder / "s")
    lines = session_lines(plan, [reading_line(v) for v in tracker_readings(plan)])
    return folder, run_calibrate(
        cell, "--session", folder / "s", "--apply", folder / "new.yaml", lines=[*lines, "yes"]
    )


def remaining(cell: Path, plan_folder: Path) -> np.ndarray:
    """Return the error of a cell at the poses of a session (N,), m, after registration."""
    from gapbridge.core.estimation.registration import register

    plan = plan_in(plan_folder)
    q = np.array([p.q for p in plan.poses])
    mass = np.array([plan.loads[p.load].mass for p in plan.poses])
    cog = np.array([plan.loads[p.load].cog for p in plan.poses])
    from gapbridge.core.loads import Loads

    loads = Loads(payload_mass=mass, payload_cog=cog)
    there = truth().predict(q, loads).position
    predicted = load_cell(cell).model.predict(q, loads).position
    return np.linalg.norm(register(there, predicted).in_base(there) - predicted, axis=1)


def test_a_session_ends_with_an_accurate_cell(clean: tuple[Path, CommandResult]) -> None:
    folder, result = clean
    assert result.code == 0, result.err
    assert remaining(folder / "cell.yaml", folder / "s").max() > 5e-4
    assert remaining(folder / "new.yaml", folder / "s").max() < 1.2e-4
    axial = load_cell(folder / "new.yaml").model.compliance()[0]
    assert axial[1] == pytest.approx(AXIAL[1], rel=0.15)
    for name in ("calibration.html", "calibration.pdf", "readings.csv", "promise.json"):
        assert (folder / "s" / name).stat().st_size > 500
    baseline = json.loads((folder / "new.promise.json").read_text())
    assert [file["role"] for file in baseline["provenance"]["files"]] == ["log", "cell"]
    assert "\ncompliance:" not in (folder / "cell.yaml").read_text()


def test_nothing_is_applied_without_a_yes(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    folder, _ = clean
    result = run_calibrate(
        folder / "cell.yaml", "--session", folder / "s", "--apply", tmp_path / "no.yaml",
        lines=["perhaps", "no"],
    )  # fmt: skip
    assert result.code == 0
    assert "nothing is applied" in result.out
    assert not (tmp_path / "no.yaml").exists()


@pytest.mark.slow
def test_corrected_mistakes_leave_the_same_calibration(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    """A reading in mm, a typo, a wrong key, an undo, a knocked tracker, interruptions."""
    cell = write_cell(tmp_path)
    run_calibrate(cell, "--plan-only", "--session", tmp_path / "s")
    plan = plan_in(tmp_path / "s")
    good, after = tracker_readings(plan), tracker_readings(plan, 1, KNOCKED)
    load = [p.load for p in plan.poses]
    wrong = good[6] + np.array([0.0, 0.09, 0.0])
    first = [
        *session_lines_from(load, good, 0, 5),
        *mounting_lines(load, 5),
        "1 2",
        reading_line(good[5], 1e3),
    ]
    first += [
        reading_line(good[5], 1e-3),
        "take",
        *mounting_lines(load, 6),
        reading_line(wrong),
        "",
        reading_line(good[6]),
        "undo",
        reading_line(good[6]),
    ]
    first += ["note the door stood open"]
    result = run_calibrate(cell, "--session", tmp_path / "s", lines=first)
    assert result.code == 0
    assert "is the unit right?" in result.out
    assert "metres taken for millimetres" in result.out
    assert "y alone is off" in result.out
    assert "found 2 numbers" in result.out
    assert "to resume: gapbridge calibrate" in result.out
    assert len(_kept(tmp_path)) == 7
    last = next(k for k in range(9, len(load)) if len(set(load[k - 3 : k + 1])) == 1)
    second = [
        *session_lines_from(load, good, 7, last),
        *mounting_lines(load, last),
        reading_line(after[last]),
        "bac",
    ]
    second += [reading_line(after[k]) for k in (last - 1, last - 2, last - 3)]
    second += ["", *session_lines_from(load, after, last, len(load)), "yes"]
    result = run_calibrate(
        cell, "--session", tmp_path / "s", "--apply", tmp_path / "new.yaml", lines=second
    )
    assert result.code == 0, result.err + result.out[-2000:]
    assert "the instrument has moved" in result.out
    assert "resuming the session" in result.out
    assert remaining(tmp_path / "new.yaml", tmp_path / "s").max() < 1.2e-4
    _same_within_intervals(clean[0] / "s", tmp_path / "s")


def test_a_first_reading_out_of_range_has_no_expected_position(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    run_calibrate(cell, "--plan-only", "--session", tmp_path / "s")
    plan = plan_in(tmp_path / "s")
    lines = ["", reading_line(tracker_readings(plan)[0], 1e-3), "", "quit"]
    result = run_calibrate(cell, "--session", tmp_path / "s", lines=lines)
    assert "this instrument cannot give such a reading" in result.out
    assert "is the unit right?" in result.out
    assert "from where it was expected" not in result.out
    assert not _kept(tmp_path)


def mounting_lines(load: list[int], stop: int) -> list[str]:
    """Return Enter if another load is mounted before a stop."""
    return [""] if stop == 0 or load[stop] != load[stop - 1] else []


def session_lines_from(load: list[int], values: np.ndarray, first: int, end: int) -> list[str]:
    """Return the input of some stops, Enter for each load included."""
    return [
        line
        for k in range(first, end)
        for line in (*mounting_lines(load, k), reading_line(values[k]))
    ]


def _kept(folder: Path) -> list[dict[str, object]]:
    entries = read_entries(folder / "s" / FILE)
    kept = [e for e in entries if e["kind"] == "reading"]
    return kept[: len(kept) - sum(e["kind"] == "undo" for e in entries)]


def _same_within_intervals(one: Path, other: Path) -> None:

    from gapbridge.core.calibration.accuracy_baseline import read_baseline

    a, b = (read_baseline(json.loads((p / "promise.json").read_text())) for p in (one, other))
    assert a.names == b.names
    spread = np.sqrt(np.diag(a.covariance) + np.diag(b.covariance))
    assert (np.abs(a.values - b.values) < 3.5 * spread).all()


def test_end_of_input_and_quit_show_how_to_resume(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    run_calibrate(cell, "--plan-only", "--session", tmp_path / "s")
    value = reading_line(tracker_readings(plan_in(tmp_path / "s"))[0])
    result = run_calibrate(cell, "--session", tmp_path / "s", lines=["", "?", value, "quit"])
    assert result.code == 0
    assert "discard the last reading" in result.out
    assert "1 of 24 stops are measured and kept; to resume: gapbridge calibrate" in result.out
    result = run_calibrate(cell, "--session", tmp_path / "s", lines=["skip"])
    assert "stop 2 is skipped" in result.out
    assert "the input ended" in result.out


@pytest.mark.parametrize(
    ("arguments", "changed", "phrase"),
    [
        (["--instrument", "typd"], {}, "--instrument: found 'typd', expected one of typed"),
        (["--instrument", "typed,unit=km"], {}, "--instrument typed: unit: found 'km', expected"),
        (["--instrument", "typed,unit=mm,sigma=true"], {}, "typed: sigma: found True, expected a"),
        (["--instrument", "typed,kind=file"], {}, "--instrument: found kind twice"),
        (["--instrument", "file,unit=mm,columns=[x,y],file=none/x.csv"], {}, "no such file"),
        (["--instrument", "typed,unit=["], {}, "--instrument: found 'unit=[', expected KEY=VALUE"),
        (
            ["--instrument", "typed,unit=!!int a"],
            {},
            "--instrument: found 'unit=!!int a', expected KEY",
        ),
        (["--instrument", "typed,unit=mm,unit=m"], {}, "--instrument: found unit twice"),
        (["--move"], {}, "calibration.joints: found 'planned' with --move, expected 'link'"),
        (["--verify"], {}, "expected the accuracy baseline that `gapbridge calibrate` writes"),
        (["--payload-only"], {}, "link: found nothing"),
        (["--verify", "--tool-only"], {}, "more than one of"),
        ([], {"held_out": 7}, "calibration.held_out: found 7"),
        ([], {"joints": "link"}, "link: found nothing, expected the robot's address"),
        ([], {"instrument": "{kind: sphere}"}, "calibration.instrument_at: found nothing"),
        ([], {"instrument": "{kind: file, unit: mm, file: none/x.csv}"}, "no such file"),
        (["--apply", "none/new.yaml"], {}, "found no folder none"),
        ([], {"instrument": GAUGE, "poses": 6}, "calibration.poses: found 6, expected at least"),
        (["--poses", "7"], {"instrument": GAUGE}, "--poses: found 7, expected at least"),
    ],
)
def test_unusable_input_is_refused_in_one_line(
    tmp_path: Path, arguments: list[str], changed: dict[str, object], phrase: str
) -> None:
    cell = write_cell(tmp_path, **{"poses": 12, **changed})
    result = run_calibrate(cell, "--session", tmp_path / "all" / "s", *arguments)
    assert result.code == 2, result
    assert phrase in result.err
    assert result.err.count("\n") == 1
    assert "Traceback" not in result.err
    assert list(tmp_path.iterdir()) == [cell]  # nothing to resume


def test_what_a_planned_session_ignores_is_told(clean: tuple[Path, CommandResult]) -> None:
    folder = clean[0]
    result = run_calibrate(folder / "cell.yaml", "--plan-only", "--session", folder / "s",
                           "--seed", "3", "--poses", "20")  # fmt: skip
    for option in ("--seed", "--poses"):
        assert f"this session already has a plan: {option} has no effect" in result.out


def test_stops_that_a_later_obstacle_does_not_allow_are_told(tmp_path: Path) -> None:
    cell, session = write_cell(tmp_path), tmp_path / "s"
    assert run_calibrate(cell, "--plan-only", "--session", session).code == 0
    resumed = run_calibrate(cell, "--session", session, lines=["quit"])
    assert "not free of them now" not in resumed.out
    assert "type `moved`" not in resumed.out  # nothing was measured
    reading = reading_line(tracker_readings(plan_in(session))[0])
    run_calibrate(cell, "--session", session, lines=["", reading, "quit"])
    cell.write_text(cell.read_text() + "  keep_out: [{lower: [0.3, -2, 0], upper: [2, 2, 2]}]\n")
    resumed = run_calibrate(cell, "--session", session, lines=["quit"])
    assert "not free of them now: stops" in " ".join(resumed.out.split())
    assert "if the instrument was moved since, type `moved`" in resumed.out


def test_a_session_resumes_only_with_its_own_cell(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    session = clean[0] / "s"
    cell = write_cell(tmp_path)
    text = cell.read_text()
    cell.write_text(text + "payload: {mass: 3.0}\n")
    result = run_calibrate(cell, "--session", session)
    assert result.code == 2
    assert "payload: found it changed since the session" in result.err
    cell.write_text(text)
    result = run_calibrate(cell, "--session", session, "--instrument", "dial_gauge,unit=mm")
    assert result.code == 2
    assert "found readings of kind position, expected distance" in result.err


def test_a_verification_accepts_the_arm_and_detects_a_bent_tool(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    cell = clean[0] / "new.yaml"
    for name, bend, phrase in (("a", 0.0, "holds"), ("b", 0.004, "tool"), ("c", 0.0, "holds")):
        session = tmp_path / name
        assert run_calibrate(cell, "--verify", "--plan-only", "--session", session).code == 0
        plan = plan_in(session)
        value = _verified(plan, bend)
        lines = session_lines(plan, [reading_line(v) for v in value])
        lines = [part for line in lines for part in ([line, "keep"] if bend and line else [line])]
        result = run_calibrate(cell, "--verify", "--session", session, lines=lines)
        assert result.code == (1 if bend else 0), result.err + result.out[-1500:]
        assert (session / "verification.html").exists()
        assert bool(read_mark(cell)) is bool(bend)
        assert result.err.count("\n") == (1 if bend else 0)
        assert phrase in result.out.lower()
        holds = next(e for e in read_entries(session / FILE) if e["kind"] == "ended")["holds"]
        assert holds is (bend == 0.0)
        if bend:  # an old session that is evaluated again says nothing of the arm today
            assert run_calibrate(cell, "--verify", "--session", tmp_path / "a").code == 0
            assert "the tool moved by" in read_mark(cell)


def test_a_verification_does_not_pass_by_the_readings_of_the_one_before(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    cell, file, plan = clean[0] / "new.yaml", tmp_path / "readings.csv", tmp_path / "p"
    given = ("--verify", "--instrument", f"file,unit=m,file={file},timeout=0.2")
    assert run_calibrate(cell, *given, "--plan-only", "--session", plan).code == 0
    stops = plan_in(plan)
    rows = [f"{i + 1},{reading_line(v)}" for i, v in enumerate(_verified(stops, 0.0))]
    file.write_text("\n".join(["stop,x,y,z", *rows]).replace(" ", ",") + "\n", encoding="utf-8")
    again = run_calibrate(cell, *given, "--session", plan, lines=["", "", ""])
    assert "the calibration holds" in again.out, again.err
    os.utime(file, (0, 0))
    later = run_calibrate(cell, *given, "--session", tmp_path / "s", lines=["", "quit"])
    assert "from before this session are not used: 10" in later.out
    assert "found no new row for 0.2 s, expected stop 1" in later.out
    assert "  kept  " not in later.out
    resumed = run_calibrate(cell, *given, "--session", tmp_path / "s", lines=["", "quit"])
    assert "found no new row for 0.2 s, expected stop 1" in resumed.out


def test_an_outlier_is_told_with_its_stop(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    entries = [e for e in read_entries(clean[0] / "s" / FILE) if e["kind"] != "ended"]
    fitted = [p.number for p in plan_in(clean[0] / "s").poses if not p.held_out and not p.repeat]
    readings = {e["stop"]: e for e in entries if e["kind"] == "reading"}
    first, last = (i for i in fitted if i in (min(fitted), max(fitted)))
    readings[last]["value"][1] += 4e-3
    index = entries.index(readings[first])
    entries[index] = {"kind": "skip", "time": readings[first]["time"], "stop": first}
    (tmp_path / "s").mkdir()
    lines = "".join(json.dumps(e) + "\n" for e in entries)
    (tmp_path / "s" / FILE).write_text(lines, encoding="utf-8")
    cell = clean[0] / "cell.yaml"
    result = run_calibrate(cell, "--session", tmp_path / "s", lines=["no", "no"])
    assert f"outlier, down-weighted: reading {last}, of stop {last + 1}" in result.out, result.err


def test_a_missed_accuracy_is_told_before_the_cell_is_written(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    text = (clean[0] / "cell.yaml").read_text(encoding="utf-8")
    shutil.copytree(clean[0] / "s", tmp_path / "s")
    for accuracy, word in (("1.0e-5", "Fail: Required"), ("1.0e-3", "Pass: Required")):
        cell = tmp_path / "cell.yaml"
        cell.write_text(f"{text}  accuracy: {accuracy}\n", encoding="utf-8")
        result = run_calibrate(cell, "--session", tmp_path / "s", lines=["no"])
        assert word in result.out[: result.out.index("[yes/no]")], result.err


def test_a_few_poses_neither_pass_a_verification_nor_remove_the_mark(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    cell, session = tmp_path / "new.yaml", tmp_path / "s"
    for name in ("new.yaml", "new.promise.json"):
        shutil.copy(clean[0] / name, tmp_path / name)
    write_mark(cell, "the zero of joint 5 moved by 10 mrad", session)
    assert run_calibrate(cell, "--verify", "--plan-only", "--session", session).code == 0
    plan = plan_in(session)
    lines = session_lines(plan, [reading_line(v) for v in _verified(plan, 0.0)])
    result = run_calibrate(cell, "--verify", "--session", session, lines=lines[:4] + ["skip"] * 7)
    assert result.code == 2
    assert "found 3 poses measured, expected at least 6" in result.err
    assert "to measure anew give another --session" in result.out
    assert "the zero of joint 5" in read_mark(cell)


def test_a_cell_edited_during_its_session_is_not_replaced_by_one_without_the_edit(
    clean: tuple[Path, CommandResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, session = tmp_path / "cell.yaml", tmp_path / "s"
    shutil.copytree(clean[0] / "s", session)
    shutil.copy(clean[0] / "cell.yaml", cell)
    evaluate = calibrate_module.evaluate_session

    def edit(*arguments: Any) -> Any:
        with cell.open("a", encoding="utf-8") as file:
            file.write("limits: {joint_margin: 0.03}\n")
        return evaluate(*arguments)

    given = ("--session", session, "--apply", tmp_path / "new.yaml")
    with monkeypatch.context() as patched:
        patched.setattr(calibrate_module, "evaluate_session", edit)
        result = run_calibrate(cell, *given, lines=["yes"])
    assert result.code == 2
    assert "cell.yaml: found it changed since the command was started" in result.err
    assert not (tmp_path / "new.yaml").exists()
    assert run_calibrate(cell, *given, lines=["yes"]).code == 0
    assert "limits: {joint_margin: 0.03}" in (tmp_path / "new.yaml").read_text(encoding="utf-8")


def test_a_baseline_of_another_calibration_is_refused(
    clean: tuple[Path, CommandResult], tmp_path: Path
) -> None:
    document = json.loads((clean[0] / "new.promise.json").read_text(encoding="utf-8"))
    other = {**document, "covariance": (1.01 * np.array(document["covariance"])).tolist()}
    for name, baseline in (("cell", document), ("new", other)):  # not calibrated; another arm
        shutil.copy(clean[0] / f"{name}.yaml", tmp_path)
        (tmp_path / f"{name}.promise.json").write_text(json.dumps(baseline), encoding="utf-8")
        cell = tmp_path / f"{name}.yaml"
        result = run_calibrate(cell, "--verify", "--session", tmp_path / f"s-{name}")
        assert result.code == 2
        assert f"{name}.promise.json: found the accuracy baseline of another" in result.err


def test_a_failed_verification_marks_the_cell_even_where_its_files_cannot_be_written(
    clean: tuple[Path, CommandResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell, session = tmp_path / "new.yaml", tmp_path / "s"
    for name in ("new.yaml", "new.promise.json"):
        shutil.copy(clean[0] / name, tmp_path / name)
    assert run_calibrate(cell, "--verify", "--plan-only", "--session", session).code == 0
    plan = plan_in(session)
    lines = session_lines(plan, [reading_line(v) for v in _verified(plan, 0.004)])

    def full(readings: object, registered: bool, path: Path) -> None:
        raise RunError(f"{path}: cannot be written: No space left on device")

    monkeypatch.setattr(verify_module, "write_log", full)
    lines = [part for line in lines for part in ([line, "keep"] if line else [line])]
    result = run_calibrate(cell, "--verify", "--session", session, lines=lines)
    assert result.code == 1
    assert "No space left" in result.err
    assert "the tool moved by" in read_mark(cell)


def _verified(plan: object, bend: float) -> np.ndarray:
    """Return readings of the true arm whose tool was displaced by ``bend`` (m) along x."""
    from dataclasses import replace

    import scripted_session as source

    from gapbridge.core.calibration.plan import Plan
    from gapbridge.core.loads import Loads

    assert isinstance(plan, Plan)
    model = source.truth()
    tool = model.tool_in_flange.copy()
    tool[0, 3] += bend
    model = replace(model, tool_in_flange=tool)
    q = np.array([p.q for p in plan.poses])
    loads = Loads(
        payload_mass=np.array([plan.loads[p.load].mass for p in plan.poses]),
        payload_cog=np.array([plan.loads[p.load].cog for p in plan.poses]),
    )
    found = model.predict(q, loads).position
    found = found + np.random.default_rng(7).normal(0, 3e-5, found.shape)
    return found @ FRAME.rotation.T + FRAME.position
