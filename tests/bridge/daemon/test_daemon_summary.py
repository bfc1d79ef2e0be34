from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gapbridge.bridge.daemon.summary import MOST_FAULTS, Faults, Histogram, RunSummary, Tally
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.core.state import CLAMPS, RATE, VELOCITY

N, RATE_HZ = 6, 500.0


def rows(timestamps: list[float], **columns: object) -> NDArray[np.float64]:
    s = slices_of(N)
    found = np.zeros((len(timestamps), s["offset"].stop))
    found[:, s["timestamp"].start] = timestamps
    for name, values in columns.items():
        found[:, s[name].start] = values
    return found


def summary(tally: Tally) -> RunSummary:
    return RunSummary(
        **tally.figures(), restarts=0, lost_rows=0, faults=(), state="observing", exit_code=0
    )


def test_quantiles_are_exact_to_a_microsecond() -> None:
    values = np.random.default_rng(1).gamma(2.0, 2e-4, 5000)
    found = Histogram()
    for part in np.array_split(values, 7):
        found.add(part)
    for share in (0.5, 0.99):
        assert found.quantile(share) == pytest.approx(np.quantile(values, share), abs=2e-6)
    assert found.largest == values.max()


def test_a_duration_beyond_the_histogram_is_kept_as_the_largest() -> None:
    found = Histogram()
    found.add(np.array([1e-3, 2.5]))
    assert found.largest == 2.5
    assert found.quantile(0.4) == pytest.approx(1e-3, abs=2e-6)


def test_without_cycles_every_figure_is_zero() -> None:
    found = summary(Tally(N, RATE_HZ))
    assert found.cycles == found.missed == 0
    assert found.rate_hz == found.missed_share == 0.0
    assert found.age_ms == {"p50": 0.0, "p99": 0.0, "max": 0.0}


def test_cycles_missed_are_counted_across_batches_and_the_rate_is_the_controllers() -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([0.0, 0.002, 0.004]))
    tally.add(rows([0.010, 0.012], missed=[2, 0]))
    found = summary(tally)
    assert (found.cycles, found.missed) == (5, 2)
    assert found.missed_share == pytest.approx(2 / 7)
    assert found.rate_hz == pytest.approx(4 / 0.012)


def test_a_break_without_missed_cycles_is_no_part_of_the_rate() -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([1.0, 1.002, 1.102, 1.104]))  # it armed in between
    tally.add(rows([0.5, 0.502]))  # a controller that was started anew
    assert summary(tally).rate_hz == pytest.approx(500.0)


def test_ages_are_those_of_setpoints_once_there_are_any() -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([0.0, 0.002], age=[9e-3, 9e-3]))
    assert summary(tally).age_ms["max"] == pytest.approx(9.0)
    tally.add(rows([0.004, 0.006], age=[1e-3, 3e-3], written=1))
    found = summary(tally)
    assert found.setpoints_written == 2
    assert found.age_ms["max"] == pytest.approx(3.0)
    assert found.late == 3


def test_limits_that_held_setpoints_back_are_counted_by_name() -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([0.0, 0.002, 0.004], clamped=[1 << RATE, 1 << RATE | 1 << VELOCITY, 0]))
    found = summary(tally)
    assert found.clamped == dict.fromkeys(CLAMPS, 0) | {"rate": 2, "velocity": 1}
    assert any("rate 2, velocity 1" in line for line in found.lines())


def test_a_summary_is_json_and_reports_the_figures_in_text() -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([0.0, 0.002], age=1e-3, duration=4e-4, written=1))
    found = summary(tally)
    reported = json.loads(json.dumps(found.to_json()))
    assert reported["setpoints_written"] == 2
    assert reported["loop_us"]["p99"] == pytest.approx(400, abs=2)
    assert reported["missed_share"] == 0.0
    text = "\n".join(found.lines())
    assert "cycles 2, missed 0 (0.000 %)" in text
    assert "p99 1.00 ms" in text


@pytest.mark.parametrize("count", [0, 1, MOST_FAULTS + 1, 2 * MOST_FAULTS, 10_000])
def test_the_faults_of_a_link_that_is_lost_for_days_fit_into_one_event(count: int) -> None:
    """Else the recorder gets neither the summary nor the end: its pipe is full."""
    faults = Faults()
    for number in range(count):
        faults.add("loop" if number else "silence", f"{number} {1000 * 'x'}")
    assert faults.cause == ("silence" if count else "")
    found = [text.split(" ")[0] for text in faults.texts]
    kept = [str(number) for number in range(count)]
    if count > 2 * MOST_FAULTS:
        others = str(count - 2 * MOST_FAULTS)
        assert found == [*kept[:MOST_FAULTS], others, *kept[-MOST_FAULTS:]]
    else:
        assert found == kept
    assert len(json.dumps(faults.texts)) < 1 << 16  # of the smallest pipe


@pytest.mark.parametrize(("lost", "said"), [(0, True), (2, True), (3, False)])
def test_a_run_of_which_nothing_could_be_recorded_names_no_recording(lost: int, said: bool) -> None:
    tally = Tally(N, RATE_HZ)
    tally.add(rows([0.0, 0.002, 0.004]))
    lines = replace(summary(tally), lost_rows=lost, recording=Path("run-1")).lines()
    assert ("recorded in run-1" in lines) == said
