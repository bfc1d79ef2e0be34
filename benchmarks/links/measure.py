"""Both sides in turns; wall time and CPU time of each cycle; medians, quartiles, minima, ratios."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from benchmarks.links.case import Cycles, Step
from gapbridge.core.errors import LinkError

EACH = 25  # cycles in one turn
WARM = 3  # untimed cycles at the begin of a turn
PARTS = ("read", "compensate", "write")


@dataclass
class Turns:
    """What one side took, us; one list per turn."""

    wall: list[list[float]] = field(default_factory=list)
    cpu: list[list[float]] = field(default_factory=list)
    cpu_link: list[list[float]] = field(default_factory=list)  # without compensation
    parts: list[list[float]] = field(default_factory=list)  # wall time of each part, per cycle
    broken: int = 0  # cycles that a LinkError ended: a torn sample, a controller that was late


def measured(cycles: Cycles, rounds: int) -> dict[str, Any]:
    """Return the figures of both sides and their ratios, after ``rounds`` turns of each."""
    ours, library = Turns(), Turns()
    sides: list[tuple[bool, tuple[Step, ...], Turns]] = [
        (True, cycles.ours, ours),
        (False, cycles.library, library),
    ]
    clock = cpu_clock(cycles.threads)
    for turn in range(rounds):
        for is_ours, steps, turns in sides if turn % 2 else reversed(sides):
            cycles.turn(is_ours)
            _one_turn(steps, cycles.wait, clock, turns)
    cycles.turn(True)
    for name, turns in (("ours", ours), ("the library's", library)):
        if not turns.wall:
            raise SystemExit(f"none of {turns.broken} cycles of {name} came through")
    figures = {"ours": figures_of(ours), "library": figures_of(library)}
    for name, parts in (("ours", PARTS), ("library", ("read", "write"))):
        turns = ours if name == "ours" else library
        medians = np.median(np.array(turns.parts), axis=0)
        figures[name]["parts_us"] = {
            part: round(float(us), 1) for part, us in zip(parts, medians, strict=True)
        }
    ratios = {
        kind: ratio_of(getattr(ours, kind), getattr(library, kind))
        for kind in ("wall", "cpu", "cpu_link")
    }
    return {**figures, "ratio": ratios}


def cpu_clock(threads: tuple[int, ...]) -> Callable[[], float]:
    """Return a clock of the CPU time (s) of the calling thread and of others."""
    others = [time.pthread_getcpuclockid(thread) for thread in threads]

    def now() -> float:
        return time.thread_time() + sum(time.clock_gettime(other) for other in others)

    return now


def _one_turn(steps: tuple[Step, ...], wait: Step, clock: Callable[[], float], to: Turns) -> None:
    wall: list[float] = []
    cpu: list[float] = []
    link: list[float] = []
    for cycle in range(WARM + EACH):
        wait()
        stamps, busy = [time.perf_counter()], [clock()]
        try:
            for step in steps:
                step()
                stamps.append(time.perf_counter())
                busy.append(clock())
        except LinkError:
            to.broken += 1
            continue
        if cycle < WARM:
            continue
        wall.append(1e6 * (stamps[-1] - stamps[0]))
        cpu.append(1e6 * (busy[-1] - busy[0]))
        link.append(1e6 * (busy[1] - busy[0] + busy[-1] - busy[-2]))  # first part and last
        to.parts.append([1e6 * d for d in np.diff(stamps)])
    if wall:
        to.wall.append(wall)
        to.cpu.append(cpu)
        to.cpu_link.append(link)


def figures_of(turns: Turns) -> dict[str, Any]:
    """Return minimum, quartiles and 99th percentile of wall and CPU time, us, over all cycles."""
    found: dict[str, Any] = {"cycles": sum(map(len, turns.wall)), "broken": turns.broken}
    for kind in ("wall", "cpu", "cpu_link"):
        values = np.concatenate(getattr(turns, kind))
        shares = np.percentile(values, [0, 25, 50, 75, 99])
        names = ("min", "p25", "p50", "p75", "p99")
        found[f"{kind}_us"] = {
            name: round(float(us), 1) for name, us in zip(names, shares, strict=True)
        }
    return found


def ratio_of(ours: list[list[float]], library: list[list[float]]) -> dict[str, float]:
    """Return ours by the library's: of medians, of minima, and the quartiles over pairs of turns.

    The quartiles say what the machine's noise does to a ratio of medians.
    """
    all_ours, all_library = np.concatenate(ours), np.concatenate(library)
    pairs = [np.median(a) / np.median(b) for a, b in zip(ours, library, strict=False)]
    low, high = np.percentile(pairs, [25, 75])
    return {
        "median": round(float(np.median(all_ours) / np.median(all_library)), 2),
        "min": round(float(all_ours.min() / all_library.min()), 2),
        "pairs_p25": round(float(low), 2),
        "pairs_p75": round(float(high), 2),
    }
