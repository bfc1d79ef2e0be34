"""Each link is measured in a process of its own, which ends at once: ur_rtde may abort its own."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.links.case import spin
from benchmarks.links.measure import measured
from benchmarks.links.table import CASES


def measured_apart(name: str, rounds: int, sleep: bool) -> dict[str, Any]:
    """Return the figures of the link of this name."""
    context = multiprocessing.get_context("spawn")
    results, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure, args=(name, rounds, sleep, sender))
    process.start()
    sender.close()
    try:
        found: dict[str, Any] = results.recv()
    except EOFError:
        raise SystemExit(f"{name}: nothing measured, see above") from None
    finally:
        process.join()
    return found


def _measure(name: str, rounds: int, sleep: bool, sender: Connection) -> None:
    sys.setswitchinterval(1e-4)  # as the daemon's loop has it
    case = next(case for case in CASES if case.name == name)
    with case.served(time.sleep if sleep else spin) as cycles:
        found = {"link": name, "compared_with": case.library, **measured(cycles, rounds)}
        # what ur_rtde says about the end of its controller is no news
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
    sender.send(found)
    os._exit(0)
