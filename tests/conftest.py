"""How the tests are shared out over processes, and what becomes of those in real time.

Tests over wires mostly wait: two processes run them, and more, if there are any, compute all others
with what is left of the cores (``make test`` has four).

Every test has one chance, and is patient about time. The few whose subject is time itself are
marked ``realtime``: such a test says nothing where the machine was late. It is skipped where the
machine cannot keep any time before it begins, and where it failed while a process beside it on any
core, which only sleeps, was woken later than a state may be old, or while its own process waited
for a core for longer than it had one. How late, or how long, is in the skip's reason.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# how fast examples are drawn says something of the machine, nothing of the code
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
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

from lateness import HOPELESS, LIMIT, Witness, core_time, core_times  # noqa: E402
from waiting import NICE, WAITING  # noqa: E402

WITNESS = Witness()
HAD = pytest.StashKey[dict[str, tuple[float, float]]]()  # s that threads had, before a test
MADE: dict[pytest.FixtureDef[Any], tuple[float, float]] = {}  # s since 1970: begun, ended


@pytest.fixture(scope="session", autouse=True)
def state(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep what daemons learn out of the user's own folder."""
    os.environ.pop("STATE_DIRECTORY", None)
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


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


@pytest.hookimpl(hookwrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]) -> Iterator[None]:
    """Note when a fixture was made: what several tests judge may have run in it."""
    begun = time.time()
    yield
    MADE[fixturedef] = (begun, time.time())


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Note what this process has had of the cores before a test."""
    item.stash[HAD] = core_times()
    yield


def worst_of(item: pytest.Item, begun: float, ended: float) -> float:
    """Return how late the machine was during a phase of a test, or while its fixtures were made."""
    info = item._fixtureinfo  # type: ignore[attr-defined]
    used = [found[-1] for found in info.name2fixturedefs.values()]
    spans = [(begun, ended), *(MADE[fixture] for fixture in used if fixture in MADE)]
    return max(WITNESS.worst(*span) for span in spans)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Judge the machine before a test in real time."""
    if item.get_closest_marker("realtime") is None:
        return
    WITNESS.start()
    late = WITNESS.worst(time.time() - 1.0, time.time())
    if late > HOPELESS and (late := WITNESS.probe()) > HOPELESS:
        pytest.skip(f"this machine keeps no time: it woke a process {1e3 * late:.0f} ms late")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Judge the machine where a test in real time has failed."""
    outcome = yield
    report = outcome.get_result()  # type: ignore[attr-defined]
    if not report.failed or item.get_closest_marker("realtime") is None:
        return
    late = worst_of(item, call.start, call.stop)
    ran, waited = core_time(item.stash[HAD])
    if late > LIMIT:
        why = (
            f"this machine woke a process {1e3 * late:.0f} ms late meanwhile, at most "
            f"{1e3 * LIMIT:.0f} ms are judged by"
        )
    elif waited > max(ran, LIMIT):
        why = (
            f"this process waited {1e3 * waited:.0f} ms for a core meanwhile and had one for "
            f"{1e3 * ran:.0f} ms, at most as long is judged by"
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
