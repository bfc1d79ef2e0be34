"""A real Dask cluster over loopback TCP, with workers that are killed."""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import LocalCluster

from gapbridge.bridge.fleet.task import BAD, DIED, DONE
from gapbridge.bridge.fleet.workers.dask_workers import DaskWorkers
from gapbridge.core.errors import RunError
from tests.bridge.fleet.fleet_in import tasks_in
from tests.bridge.fleet.jobs import count_rows, kill_itself


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", protocol="tcp",
        dashboard_address=None, silence_logs=50,
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address


@pytest.mark.slow
def test_a_cluster_does_every_session_and_one_of_its_workers_may_die(
    address: str, tmp_path: Path
) -> None:
    names = [f"arm{i}/s" for i in range(16)]
    tasks = tasks_in(tmp_path, names, count_rows, {"pause": 0.1})
    outcomes = []
    with DaskWorkers(address) as workers:
        for outcome in workers.run(tasks):
            outcomes.append(outcome)
            if len(outcomes) == 4:
                os.kill(outcome.result["process"], signal.SIGKILL)
    assert Counter(o.session for o in outcomes) == Counter(names)
    assert {o.state for o in outcomes} == {DONE}
    assert len({o.result["process"] for o in outcomes}) >= 2


@pytest.mark.slow
def test_a_session_that_kills_workers_is_begun_twice_and_harms_no_other(
    address: str, tmp_path: Path
) -> None:
    book = tmp_path / "book"
    names = ["a/killer", *(f"c/s{i}" for i in range(5))]
    tasks = tasks_in(tmp_path, names, kill_itself, {"book": str(book)})
    with DaskWorkers(address) as workers:
        outcomes = {o.session: o for o in workers.run(tasks)}
    assert set(outcomes) == set(names)
    assert outcomes.pop("a/killer").state == DIED
    assert {o.state for o in outcomes.values()} == {DONE}
    assert Counter(book.read_text().split())["killer"] == 2


@pytest.mark.slow
def test_a_bad_log_is_one_outcome_among_others(address: str, tmp_path: Path) -> None:
    tasks = tasks_in(tmp_path, ["a/s", "b/s"], count_rows)
    tasks[0].log.write_text("nonsense\n1\n")
    with DaskWorkers(address) as workers:
        outcomes = {o.session: o for o in workers.run(tasks)}
    assert outcomes["a/s"].state == BAD
    assert outcomes["b/s"].state == DONE


@pytest.mark.slow
def test_an_address_without_a_scheduler_is_reported_in_one_line() -> None:
    with pytest.raises(RunError, match="found no Dask scheduler there") as error:
        DaskWorkers("tcp://127.0.0.1:9", timeout=1.0).start()
    assert "\n" not in str(error.value)
