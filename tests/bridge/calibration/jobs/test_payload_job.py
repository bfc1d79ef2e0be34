"""The short session of a new load: what it writes, and what it does not."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gapbridge.bridge.calibration.jobs.job import baseline_path, short_plan
from gapbridge.bridge.calibration.jobs.short import PayloadJob
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.journal import FILE, Journal, read_entries
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Reading, Session
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.verification_mark import mark_path, read_mark, write_mark
from gapbridge.core.calibration.payload_session import weight_columns
from gapbridge.core.calibration.plan import Payload, PlannedPose
from gapbridge.core.errors import RunError

CELL = "robot: {model: ur10e}\nlink: {driver: ur_rtde, host: 192.0.2.1}\n"


@pytest.fixture(params=[""])
def job(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[PayloadJob]:
    """Return the job of a session without readings, which writes new.yaml without asking."""
    (tmp_path / "cell.yaml").write_text(CELL + request.param, encoding="utf-8")
    cell = load_cell(tmp_path / "cell.yaml")
    options = SessionOptions(
        "payload", None, cell.calibration.instrument, new_cell=tmp_path / "new.yaml", yes=True
    )
    with Journal(tmp_path / "s") as journal:
        session = Session.of(journal)
        session.add("begun")
        yield PayloadJob(cell, options, Prompt(), session)


def measure(job: PayloadJob, mass: float) -> None:
    """Add readings of a sensor that carries ``mass`` (kg)."""
    rng = np.random.default_rng(2)
    q = rng.uniform(-2, 2, (6, 6))
    job.session.add_plan(
        short_plan(
            (Payload(1.0),), [PlannedPose(i, row, 0, np.zeros(6)) for i, row in enumerate(q)]
        )
    )
    true = np.array([mass, 0, 0, mass * 0.05, 1, 2, 3, 0.1, 0.2, 0.3])
    noise = rng.normal(0, [0.1] * 3 + [0.01] * 3, (6, 6))
    for i, wrench in enumerate(weight_columns(job.cell.model, q) @ true + noise):
        reading = Reading(
            stop=i, q=q[i], value=np.zeros(0), scatter=float("nan"), samples=1, load=0, station=0,
            target=0, approach=np.zeros(6), raw_wrench=wrench,
        )  # fmt: skip
        job.session.add("reading", **reading.entry())


def ended(job: PayloadJob) -> list[object]:
    """Return what each end of the session applied."""
    entries = read_entries(job.folder / FILE)
    return [entry["applied"] for entry in entries if entry["kind"] == "ended"]


def test_a_load_is_written_into_a_cell_that_loads(job: PayloadJob, tmp_path: Path) -> None:
    measure(job, 4.0)
    job.finish()
    assert load_cell(tmp_path / "new.yaml").file.payload.mass == pytest.approx(4.0, abs=0.1)
    assert ended(job) == [str(tmp_path / "new.yaml")]


def test_a_flange_without_a_load_is_written_as_no_mass(job: PayloadJob, tmp_path: Path) -> None:
    measure(job, -0.002)
    job.finish()
    payload = load_cell(tmp_path / "new.yaml").file.payload
    assert (payload.mass, payload.cog) == (0.0, [0.0, 0.0, 0.0])


@pytest.mark.parametrize("job", ["payload: {mass: 5.0}\n"], indirect=True)
def test_a_declared_load_that_the_sensor_does_not_find_is_not_taken_away(
    job: PayloadJob, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measure(job, 0.002)
    job.finish()
    assert "finds no load, the cell declares 5 kg" in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "new.yaml").exists()
    assert ended(job) == [None]


@pytest.mark.parametrize("job", ["payload: {mass: 5.0}\n"], indirect=True)
@pytest.mark.parametrize(("mass", "unit"), [(5.0 / 4.448, "lbf"), (5.0 / 9.807, "kgf"), (1.3, "")])
def test_a_load_as_a_sensor_in_another_unit_weighs_it_is_warned_of(
    job: PayloadJob, capsys: pytest.CaptureFixture[str], mass: float, unit: str
) -> None:
    measure(job, mass)
    job.finish()
    shown = " ".join(capsys.readouterr().out.split())
    assert ("does the sensor read" in shown) is bool(unit)
    assert f"cell's 5 kg: does the sensor read {unit}? expected N" in shown or not unit


def test_a_cell_made_of_one_whose_verification_failed_is_marked_too(
    job: PayloadJob, tmp_path: Path
) -> None:
    write_mark(job.cell.path, "the zero of joint 5 moved by 10 mrad", job.folder)
    measure(job, 4.0)
    job.finish()
    assert "the zero of joint 5 moved" in read_mark(tmp_path / "new.yaml")


def test_a_reversed_sensor_is_reported_and_writes_no_cell(
    job: PayloadJob, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    measure(job, -2.0)
    job.finish()
    assert "nothing is applied: the load weighs -2.0" in capsys.readouterr().out
    assert not (tmp_path / "new.yaml").exists()
    assert ended(job) == [None]


def test_a_cell_that_could_not_be_loaded_is_not_written(job: PayloadJob, tmp_path: Path) -> None:
    measure(job, 200.0)
    with pytest.raises(RunError, match=r"nothing is written.*payload.*mass: found 19\d"):
        job.finish()
    assert not (tmp_path / "new.yaml").exists()
    assert ended(job) == []


def test_a_baseline_is_beside_the_cell_that_a_link_leads_to(
    job: PayloadJob, tmp_path: Path
) -> None:
    real = tmp_path / "arms" / "arm7.yaml"
    real.parent.mkdir()
    real.write_text("", encoding="utf-8")
    (tmp_path / "new.yaml").symlink_to(real)
    job.write_new_cell(job.cell.model, "the cell", baseline={"kind": "position"})
    assert json.loads((real.parent / "arm7.promise.json").read_text()) == {"kind": "position"}
    assert load_cell(real).arm.n == 6
    assert baseline_path(tmp_path / "new.yaml") == baseline_path(real)


def test_a_cell_and_its_baseline_are_written_before_the_end_or_not_at_all(
    job: PayloadJob, tmp_path: Path
) -> None:
    new, model, baseline = tmp_path / "new.yaml", job.cell.model, {"kind": "position"}
    write_mark(new, "the tool moved", job.folder)
    baseline_path(new).mkdir()
    with pytest.raises(RunError, match="promise"):
        job.write_new_cell(model, "the cell", baseline=baseline)
    assert not new.exists()
    assert mark_path(new).exists()
    assert ended(job) == []
    baseline_path(new).rmdir()
    job.write_new_cell(model, "the cell", baseline=baseline)
    assert json.loads(baseline_path(new).read_text()) == baseline
    assert load_cell(new).arm.n == 6
    assert not mark_path(new).exists()
    assert ended(job) == [str(new)]
