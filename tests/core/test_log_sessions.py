"""Several logs as the sessions of one: names, clocks, columns, what does not belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import LogError
from gapbridge.core.fitted_range import Outside, merged, range_of
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of
from gapbridge.core.sessions import join_sessions, session_of, sessions_in, with_sessions

MODEL = replace(
    Model(builtin_arm("ur5e")), payload_mass=2.5, payload_cog=np.array([0.0, 0.01, 0.05])
)


def poses(rows: int, name: str, start: float = 0.0, seed: int = 0, **more) -> Log:
    rng = np.random.default_rng(seed)
    columns = {
        "timestamp": start + 10.0 * np.arange(rows),
        "actual_q": rng.uniform(-1, 1, (rows, 6)),
        "measured_position": rng.normal(size=(rows, 3)),
    } | more
    return Log(name, {k: np.asarray(v, dtype=float) for k, v in columns.items()}, 6)


def moving(name: str, start: float = 0.0) -> Log:
    t = start + np.arange(400) * 0.01
    q = np.sin(t)[:, None] * np.linspace(0.2, 1, 6)
    return Log(name, {"timestamp": t, "actual_q": q, "target_q": q}, 6)


def outside_of(log, fitted):
    found = Outside(fitted)
    found.add(log)
    return [log_finding_text(finding) for finding in found.findings()]


def test_sessions_in_order_keep_their_clock_and_rows() -> None:
    log = join_sessions([poses(4, "a.csv"), poses(3, "b.csv", start=500.0)], MODEL)
    assert log.session_names == ("a.csv", "b.csv")
    assert log.one_clock
    assert session_of(log).tolist() == [0, 0, 0, 0, 1, 1, 1]
    assert log.columns["timestamp"][4] == 500.0
    assert [log.line(r) for r in range(7)] == [2, 3, 4, 5, 2, 3, 4]
    assert [len(part) for part in sessions_in(log)] == [4, 3]


def test_clocks_that_overlap_go_one_after_the_other() -> None:
    log = join_sessions([poses(4, "a.csv"), poses(3, "b.csv")], MODEL)
    assert not log.one_clock
    time = log.columns["timestamp"]
    assert (np.diff(time) > 0).all()
    assert np.diff(time)[4:].tolist() == [10.0, 10.0]


def test_a_column_session_is_several_sessions() -> None:
    log = with_sessions(poses(6, "a.csv", session=[3, 3, 3, 7, 7, 7]), MODEL)
    assert log.session_names == ("3", "7")
    assert session_of(log).tolist() == [0, 0, 0, 1, 1, 1]
    one = with_sessions(poses(6, "a.csv", session=[3] * 6), MODEL)
    assert one.session_names == ()


def test_a_session_without_a_load_column_takes_the_models_own() -> None:
    loaded = poses(3, "a.csv", payload=[1, 2, 3], joint_temperatures=np.full((3, 6), 40.0))
    log = join_sessions([loaded, poses(2, "b.csv", start=900)], MODEL)
    assert log.columns["payload"].tolist() == [1, 2, 3, 2.5, 2.5]
    assert log.columns["joint_temperatures"][3:].tolist() == [[25.0] * 6] * 2


def test_no_motion_runs_from_one_session_into_the_next() -> None:
    first, second = poses(3, "a.csv"), poses(3, "b.csv", start=900, seed=1)
    log = join_sessions([first, second], MODEL)
    approach = log.loads().approach
    assert approach is not None
    assert not approach[3].any()
    motion = motion_of(join_sessions([moving("a"), moving("b", start=4.0)], MODEL))
    assert motion.stretch[399] != motion.stretch[400]
    assert motion.recorded_time[-1] < 8.0


@pytest.mark.parametrize(
    ("logs", "phrase"),
    [
        ([poses(6, "a.csv", session=[1, 1, 2, 2, 1, 1])],
         ["a.csv", "row 6", "session", "found 1 again", "side by side"]),
        ([poses(3, "a.csv", session=[1, 1.5, 2])],
         ["a.csv", "row 3", "found 1.5", "whole number"]),
        ([poses(4, "a.csv", session=[1, 1, 2, 2]), poses(3, "b.csv")],
         ["a.csv", "several sessions beside further logs"]),
        ([poses(30, "a.csv"), moving("b.csv")],
         ["a.csv", "poses at rest", "b.csv", "sessions of one kind"]),
        ([poses(3, "a.csv"), poses(3, "a.csv")], ["a.csv", "found twice"]),
    ],
)  # fmt: skip
def test_what_does_not_belong_together_is_reported(logs: list[Log], phrase: list[str]) -> None:
    with pytest.raises(LogError) as error:
        join_sessions(logs, MODEL)
    assert "\n" not in str(error.value)
    for word in phrase:
        assert word in str(error.value)


def test_rows_outside_what_was_fitted_are_named() -> None:
    fitted = range_of(poses(50, "a.csv", payload=np.linspace(0, 3, 50)))
    assert fitted["payload"] == (0.0, 3.0)
    assert outside_of(poses(20, "b.csv", payload=np.full(20, 2.0)), fitted) == []
    (reported,) = outside_of(poses(2, "b.csv", payload=[1.0, 9.0]), fitted)
    for word in ("payload", "1 of 2 rows", "0 to 3 kg", "row 3", "9"):
        assert word in reported
    whole = merged([fitted, {"payload": (2.0, 10.0)}])
    assert outside_of(poses(2, "b.csv", payload=[1.0, 9.0]), whole) == []
