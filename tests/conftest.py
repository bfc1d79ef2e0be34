"""How the tests are shared out over processes, and what becomes of those in real time.

Tests over wires mostly wait: two processes run them, and more, if there are any, compute all others
with what is left of the cores (``make test`` has four).

Every test has one chance, and is patient about time. The few whose subject is time itself are
marked ``realtime(limit=...)``: such a test says nothing where the machine is later than its subject
bears (s; left out: as old as a state may be). Processes that only sleep, one on each core, measure
that. It is skipped where one is woken later than the limit just before it begins, and where it
failed and one was woken later than the limit meanwhile, or one of its own threads could run but had
no core for more than half of its time. How late, or how long, is in the skip's reason. What a test
says by ``pytest.fail`` is no matter of time, and always counts.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# how fast examples are drawn says something of the machine, nothing of the code
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
# the same examples in every run; --hypothesis-profile=search looks for others
settings.register_profile(
    "any machine", settings.get_profile("search"), derandomize=True, database=None
)
settings.load_profile("any machine")

# texts have local times of day
os.environ["TZ"] = "UTC"
time.tzset()

# Two processes share the cores: threads of linear algebra within each only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

HERE = Path(__file__).parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from lateness import CASES, LIMIT, STARVED, Witness, core_waits, longest_wait  # noqa: E402
from waiting import NICE, WAITING  # noqa: E402

WITNESS = Witness()
NUMBERS = itertools.count()
BEGUN = pytest.StashKey[tuple[float, dict[str, float]]]()  # s since 1970; s that threads had waited
MADE: dict[pytest.FixtureDef[Any], tuple[float, float]] = {}  # s since 1970: begun, ended


@pytest.fixture(autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep what daemons learn out of the user's own folder, and of the next test's daemons."""
    os.environ.pop("STATE_DIRECTORY", None)
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.getbasetemp() / f"state-{next(NUMBERS)}")


def pytest_configure(config: pytest.Config) -> None:
    """Have a process that only computes leave the cores to those that are due."""
    worker = getattr(config, "workerinput", {}).get("workerid", WAITING[0])
    if worker not in WAITING:
        os.nice(NICE)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Share out whole files; those that mostly wait to two processes."""
    from shared_out import Scheduling

    return Scheduling(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Note which tests are in real time, before any is deselected."""
    CASES[:] = [i.nodeid for i in items if i.get_closest_marker("realtime")]


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
    """Note when a fixture was made: what several tests judge may have run in it."""
    begun = time.time()
    yield
    MADE[fixturedef] = (begun, time.time())


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Note when a test begins, and how long the threads of this process had waited for a core."""
    item.stash[BEGUN] = time.time(), core_waits()
    yield


def worst_of(item: pytest.Item, begun: float, ended: float) -> float:
    """Return how late the machine was during a phase of a test, or while its fixtures were made."""
    info = item._fixtureinfo  # type: ignore[attr-defined]
    used = [found[-1] for found in info.name2fixturedefs.values()]
    spans = [(begun, ended), *(MADE[fixture] for fixture in used if fixture in MADE)]
    return max(WITNESS.worst(*span) for span in spans)


def limit_of(item: pytest.Item) -> float | None:
    """Return how late the machine may be for a test, s; None where time is not its subject."""
    mark = item.get_closest_marker("realtime")
    return None if mark is None else float(mark.kwargs.get("limit", LIMIT))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Judge the machine before a test in real time."""
    limit = limit_of(item)
    if limit is None:
        return
    WITNESS.start()
    if (late := WITNESS.probe()) > limit:
        pytest.skip(
            f"this machine woke a process {1e3 * late:.0f} ms late just before, at most "
            f"{1e3 * limit:.0f} ms are judged by"
        )


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Judge the machine where a test in real time has failed."""
    outcome = yield
    report = outcome.get_result()  # type: ignore[attr-defined]
    limit = limit_of(item)
    if not report.failed or limit is None:
        return
    if call.excinfo is not None and call.excinfo.errisinstance(pytest.fail.Exception):
        return
    late = worst_of(item, call.start, call.stop)
    begun, waits = item.stash[BEGUN]
    waited, lasted = longest_wait(waits), time.time() - begun
    if late > limit:
        why = (
            f"this machine woke a process {1e3 * late:.0f} ms late meanwhile, at most "
            f"{1e3 * limit:.0f} ms are judged by"
        )
    elif waited > STARVED * lasted:
        why = (
            f"this test had no core for {1e3 * waited:.0f} ms of its {1e3 * lasted:.0f} ms though "
            "it could run, at most half is judged by"
        )
    else:
        return
    words = str(call.excinfo.value).splitlines() if call.excinfo is not None else []
    reason = f"{why}; it ended with: {(words or [''])[0][:200]}"
    report.outcome = "skipped"
    report.longrepr = (str(item.path), item.location[1] or 0, f"Skipped: {reason}")


def pytest_sessionfinish() -> None:
    """End what watches the machine."""
    WITNESS.stop()
