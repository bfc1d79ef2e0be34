"""The loop's own process: killed, crashed, hanging, late."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, seconds


def _send(rig: Rig, number: signal.Signals) -> int | None:
    """Send a signal to the loop; returns its process id, None where there is none just now."""
    pid = rig.run.daemon.loop_pid
    if pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
    return pid


def _signal(number: signal.Signals):  # type: ignore[no-untyped-def]
    def inject(rig: Rig) -> None:
        _send(rig, number)

    return inject


def pause(duration: float):  # type: ignore[no-untyped-def]
    """Return an injection: the loop stands still for a while, as on a machine that is asleep."""

    def inject(rig: Rig) -> None:
        pid = _send(rig, signal.SIGSTOP)
        time.sleep(duration)
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)

    return inject


def _stutter(rig: Rig) -> None:
    """Stop the loop again and again, each time for a few cycles."""
    stop = pause(max(4.0 * rig.link.cycle, 0.02))

    def work() -> None:
        for _ in range(8):
            stop(rig)
            time.sleep(0.03)

    threading.Thread(target=work, daemon=True).start()


ROWS = (
    Row("loop is killed", "core crashes (other process)", "SIGKILL of the loop",
        _signal(signal.SIGKILL), within=seconds(0.3), slow=True),
    Row("loop crashes", "core crashes (other process)", "SIGSEGV in the loop",
        _signal(signal.SIGSEGV), within=seconds(0.5), slow=True),
    Row("loop hangs", "core hangs (other process)", "SIGSTOP of the loop",
        _signal(signal.SIGSTOP), within=seconds(1.6), slow=True),
    Row("loop overruns", "loop overrun", "the loop stopped 8 times for 4 cycles or 20 ms",
        _stutter, within=seconds(1.5), sign="overrun|resync|late"),
    Row("suspended", "wall-clock jump, suspend", "the loop stopped for 0.4 s",
        pause(0.4), within=seconds(0.8), sign="resync|overrun|stale", end=("observing", "fault")),
)  # fmt: skip
