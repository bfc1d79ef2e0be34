"""Whole sessions through the command: mistakes, breaks and their mending, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from played import (
    AXIAL,
    FRAME,
    KNOCKED,
    Played,
    plan_in,
    play,
    positions,
    script,
    truth,
    typed,
    write_cell,
)

from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Played]:
    """Return the folder of a session without mistakes, and how it went."""
    folder = tmp_path_factory.mktemp("clean")
    cell = write_cell(folder)
    assert play(cell, "--plan-only", "--session", folder / "s").code == 0
    plan = plan_in(folder / "s")
    lines = script(plan, [typed(v) for v in positions(plan)])
    return folder, play(
        cell, "--session", folder / "s", "--apply", folder / "new.yaml", lines=[*lines, "yes"]
    )


def remaining(cell: Path, plan_folder: Path) -> np.ndarray:
    """Return how far a cell's prediction is off at the session's poses (N,), m, rigidly fitted."""
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


def test_a_session_ends_with_a_cell_that_knows_the_arm(clean: tuple[Path, Played]) -> None:
    folder, played = clean
    assert played.code == 0, played.err
    assert remaining(folder / "cell.yaml", folder / "s").max() > 5e-4
    assert remaining(folder / "new.yaml", folder / "s").max() < 1.2e-4
    axial = load_cell(folder / "new.yaml").model.compliance()[0]
    assert axial[1] == pytest.approx(AXIAL[1], rel=0.15)
    for name in ("calibration.html", "calibration.pdf", "readings.csv", "promise.json"):
        assert (folder / "s" / name).stat().st_size > 500
    baseline = json.loads((folder / "new.promise.json").read_text())
    assert [file["role"] for file in baseline["provenance"]["files"]] == ["log", "cell"]
    assert "\ncompliance:" not in (folder / "cell.yaml").read_text()


def test_nothing_is_applied_without_a_yes(clean: tuple[Path, Played], tmp_path: Path) -> None:
    folder, _ = clean
    played = play(
        folder / "cell.yaml", "--session", folder / "s", "--apply", tmp_path / "no.yaml",
        lines=["perhaps", "no"],
    )  # fmt: skip
    assert played.code == 0
    assert "nothing is applied" in played.out
    assert not (tmp_path / "no.yaml").exists()


def test_mistakes_on_the_way_leave_the_same_calibration(
    clean: tuple[Path, Played], tmp_path: Path
) -> None:
    """A reading in mm, a typo, a wrong key, an undo, a knocked tracker, breaks in between."""
    cell = write_cell(tmp_path)
    play(cell, "--plan-only", "--session", tmp_path / "s")
    plan = plan_in(tmp_path / "s")
    good, after = positions(plan), positions(plan, 1, KNOCKED)
    load = [p.load for p in plan.poses]
    wrong = good[6] + np.array([0.0, 0.09, 0.0])
    first = [*script_from(load, good, 0, 5), *hung(load, 5), "1 2", typed(good[5], 1e3)]
    first += [
        typed(good[5], 1e-3),
        "take",
        *hung(load, 6),
        typed(wrong),
        "",
        typed(good[6]),
        "undo",
        typed(good[6]),
    ]
    first += ["note the door stood open"]
    played = play(cell, "--session", tmp_path / "s", lines=first)
    assert played.code == 0
    assert "is the unit right?" in played.out
    assert "metres taken for millimetres" in played.out
    assert "y alone is off" in played.out
    assert "found 2 numbers" in played.out
    assert "to resume: gapbridge calibrate" in played.out
    assert len(_kept(tmp_path)) == 7
    last = next(k for k in range(9, len(load)) if len(set(load[k - 3 : k + 1])) == 1)
    second = [*script_from(load, good, 7, last), *hung(load, last), typed(after[last]), "back"]
    second += [typed(after[k]) for k in (last - 1, last - 2, last - 3)]
    second += ["", *script_from(load, after, last, len(load)), "yes"]
    played = play(cell, "--session", tmp_path / "s", "--apply", tmp_path / "new.yaml", lines=second)
    assert played.code == 0, played.err + played.out[-2000:]
    assert "the instrument has moved" in played.out
    assert "resuming the session" in played.out
    assert remaining(tmp_path / "new.yaml", tmp_path / "s").max() < 1.2e-4
    _same_within_intervals(clean[0] / "s", tmp_path / "s")


def test_the_first_reading_in_another_unit_is_held_to_no_expected_place(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    play(cell, "--plan-only", "--session", tmp_path / "s")
    plan = plan_in(tmp_path / "s")
    lines = ["", typed(positions(plan)[0], 1e-3), "", "quit"]
    played = play(cell, "--session", tmp_path / "s", lines=lines)
    assert "this instrument cannot give such a reading" in played.out
    assert "is the unit right?" in played.out
    assert "from where it was expected" not in played.out
    assert not _kept(tmp_path)


def hung(load: list[int], stop: int) -> list[str]:
    """Return Enter where another load is hung before a stop."""
    return [""] if stop == 0 or load[stop] != load[stop - 1] else []


def script_from(load: list[int], values: np.ndarray, first: int, end: int) -> list[str]:
    """Return the lines of some stops, loads hung on the way."""
    return [line for k in range(first, end) for line in (*hung(load, k), typed(values[k]))]


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


def test_an_ended_input_and_quit_end_in_order_and_show_how_to_go_on(tmp_path: Path) -> None:
    cell = write_cell(tmp_path)
    play(cell, "--plan-only", "--session", tmp_path / "s")
    value = typed(positions(plan_in(tmp_path / "s"))[0])
    played = play(cell, "--session", tmp_path / "s", lines=["", "?", value, "quit"])
    assert played.code == 0
    assert "discard the last reading" in played.out
    assert "1 of 24 stops are measured and kept; to resume: gapbridge calibrate" in played.out
    played = play(cell, "--session", tmp_path / "s", lines=["skip"])
    assert "stop 2 is skipped" in played.out
    assert "the input ended" in played.out


@pytest.mark.parametrize(
    ("arguments", "changed", "phrase"),
    [
        (["--instrument", "typd"], {}, "--instrument: found 'typd', expected one of typed"),
        (["--instrument", "typed,unit=km"], {}, "--instrument typed: unit"),
        (["--move"], {}, "calibration.joints: found 'planned' with --move, expected 'link'"),
        (["--verify"], {}, "expected the accuracy baseline that `gapbridge calibrate` writes"),
        (["--payload-only"], {}, "link: found nothing"),
        (["--verify", "--tool-only"], {}, "more than one of"),
        ([], {"held_out": 7}, "calibration.held_out: found 7"),
        ([], {"joints": "link"}, "link: found nothing, expected the robot's address"),
        ([], {"instrument": "{kind: sphere}"}, "calibration.instrument_at: found nothing"),
        ([], {"instrument": "{kind: file, unit: mm, file: none/x.csv}"}, "no such file"),
        (["--apply", "none/new.yaml"], {}, "found no folder none"),
    ],
)
def test_unusable_input_is_refused_in_one_line(
    tmp_path: Path, arguments: list[str], changed: dict[str, object], phrase: str
) -> None:
    cell = write_cell(tmp_path, **{"poses": 12, **changed})
    played = play(cell, "--session", tmp_path / "s", *arguments)
    assert played.code == 2, played
    assert phrase in played.err
    assert played.err.count("\n") == 1
    assert "Traceback" not in played.err


def test_a_session_goes_on_only_with_the_cell_it_was_begun_for(
    clean: tuple[Path, Played], tmp_path: Path
) -> None:
    session = clean[0] / "s"
    cell = write_cell(tmp_path)
    text = cell.read_text()
    cell.write_text(text + "payload: {mass: 3.0}\n")
    played = play(cell, "--session", session)
    assert played.code == 2
    assert "payload: found it changed since the session" in played.err
    cell.write_text(text)
    played = play(cell, "--session", session, "--instrument", "dial_gauge,unit=mm")
    assert played.code == 2
    assert "found readings of kind position, expected distance" in played.err


def test_months_later_the_calibration_holds_and_a_deflected_tool_is_seen(
    clean: tuple[Path, Played], tmp_path: Path
) -> None:
    cell = clean[0] / "new.yaml"
    for bend, phrase in ((0.0, "holds"), (0.004, "tool")):
        session = tmp_path / f"v{bend:g}"
        assert play(cell, "--verify", "--plan-only", "--session", session).code == 0
        plan = plan_in(session)
        value = _verified(plan, bend)
        lines = script(plan, [typed(v) for v in value])
        lines = [part for line in lines for part in ([line, "keep"] if bend and line else [line])]
        played = play(cell, "--verify", "--session", session, lines=lines)
        assert played.code == 0, played.err + played.out[-1500:]
        assert (session / "verification.html").exists()
        assert phrase in played.out.lower()
        holds = next(e for e in read_entries(session / FILE) if e["kind"] == "ended")["holds"]
        assert holds is (bend == 0.0)


def _verified(plan: object, bend: float) -> np.ndarray:
    """Return readings of the hidden arm whose tool was bent sideways by ``bend`` m."""
    from dataclasses import replace

    import played as source

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
