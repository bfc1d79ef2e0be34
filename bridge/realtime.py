"""Punctuality of the loop's process, as far as the system permits; what fails is left out."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import resource
import signal
import sys

PRIORITY = 50
SWITCH_INTERVAL = 1e-4  # s
_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29


def settle() -> None:
    """Collect once, then never again: a collection of many objects takes tens of milliseconds.

    To be called when everything is built; the loop makes no reference cycles.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)


def raise_priority() -> tuple[str, ...]:
    """Ask for real-time scheduling and locked memory; returns what was granted.

    To be called before the robot's library is used, whose threads inherit the priority.
    """
    granted = []
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        granted.append(f"SCHED_FIFO {PRIORITY}")
    if not granted:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, -10)
            granted.append("nice -10")
    if sys.platform.startswith("linux"):
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0:
            granted.append("timer slack 1 ns")
        # under a limit, locking what comes later would make allocations fail
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        free = os.geteuid() == 0 or limit == resource.RLIM_INFINITY
        if free and libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
            granted.append("locked memory")
    return tuple(granted)


def end_with_parent() -> None:
    """Have the kernel send SIGTERM when the parent dies, so that the arm is not left to itself."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
