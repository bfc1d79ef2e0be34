"""The measurement of a cycle's cost, on sides whose costs are known."""

import subprocess
import sys
import threading
import time

from patience import PATIENCE

from benchmarks.links.case import Cycles, nothing
from benchmarks.links.measure import cpu_clock, measured
from gapbridge.core.errors import StaleStateError


def busy(seconds: float) -> None:
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_ratios_count_compensation_where_they_say_so() -> None:
    ours = (lambda: busy(1e-3), lambda: busy(1e-3), lambda: busy(1e-3))
    library = (lambda: busy(5e-4), lambda: busy(5e-4))
    found = measured(Cycles(ours, library, nothing), rounds=2)
    assert 2.7 < found["ratio"]["cpu"]["median"] < 3.3
    assert 1.8 < found["ratio"]["cpu_link"]["median"] < 2.2
    assert found["ours"]["cycles"] == found["library"]["cycles"] == 50


def test_waiting_is_wall_time_and_no_cpu_time() -> None:
    waiting = (nothing, nothing, lambda: time.sleep(2e-3))
    found = measured(Cycles(waiting, (nothing, lambda: busy(1e-3)), nothing), rounds=2)
    assert found["ours"]["wall_us"]["min"] >= 2000.0
    assert found["ours"]["cpu_us"]["p50"] < 1000.0


def test_another_threads_work_for_the_cycle_counts() -> None:
    done = threading.Event()
    thread = threading.Thread(target=lambda: (busy(0.05), done.set(), time.sleep(0.5)))
    thread.start()
    assert thread.ident is not None
    clock = cpu_clock((thread.ident,))
    before = clock()
    done.wait(PATIENCE)
    assert clock() - before > 0.02
    thread.join()


def test_cycles_that_the_link_broke_are_counted_apart() -> None:
    calls = iter(range(1000))

    def read() -> None:
        if next(calls) % 5 == 4:
            raise StaleStateError("late")

    found = measured(Cycles((read, nothing, nothing), (nothing, nothing), nothing), rounds=2)
    assert found["ours"]["broken"] == 11
    assert found["library"]["broken"] == 0


def test_an_unknown_link_is_refused_by_name() -> None:
    command = [sys.executable, "-m", "benchmarks.links", "--links", "profibus"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 2
    assert "--links: found 'profibus', expected ur_rtde (offset)" in found.stderr
