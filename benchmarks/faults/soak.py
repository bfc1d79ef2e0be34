"""Faults every few seconds for a long while: ``python -m benchmarks.faults.soak --rate 500``.

Prints what was written, what was missed outside faults, and how the memory of each process grew.
"""

from __future__ import annotations

import contextlib
import random
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import click
import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.faults.links import LIMITS, LINKS
from benchmarks.faults.report import PAGE, fill
from benchmarks.faults.rig import Rig
from benchmarks.faults.table import rows_of
from benchmarks.machine_stalls import MachineStalls, Missed

Array = NDArray[np.float64]
QUIET = 1.0  # s of compensating after a fault that do not count as quiet
SAMPLE = 1.0  # s between two looks at the memory


@dataclass
class Memory:
    """Resident memory over time, by process: (s, MB)."""

    points: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    def look(self, rig: Rig, begun: float) -> None:
        """Take down what each process of the daemon holds now."""
        pids = {f"loop {rig.run.daemon.loop_pid}": rig.run.daemon.loop_pid}
        pids |= {
            f"{name}": side["pid"] for name, side in rig.run.daemon.side_processes.status().items()
        }
        for name, pid in pids.items():
            if pid is None:
                continue
            try:
                size = psutil.Process(pid).memory_info().rss / 1e6
            except psutil.Error:
                continue
            self.points.setdefault(name, []).append((time.monotonic() - begun, size))

    def slope(self, prefix: str) -> tuple[float, float, float]:
        """Return MB a minute of the process seen longest, its last MB, and for how long, s.

        The first fifth of its life is left out: what is loaded once is no leak.
        """
        series = [points for name, points in self.points.items() if name.startswith(prefix)]
        if not series:
            return 0.0, 0.0, 0.0
        longest = np.array(max(series, key=lambda points: points[-1][0] - points[0][0]))
        kept = longest[len(longest) // 5 :]
        span = float(longest[-1, 0] - longest[0, 0])
        rate = float(np.polyfit(kept[:, 0], kept[:, 1], 1)[0]) * 60.0 if len(kept) > 2 else 0.0
        return rate, float(longest[-1, 1]), span


@dataclass
class Quiet:
    """Cycles while nothing was wrong: how many there were, how many were missed."""

    cycles: int = 0
    missed: list[Missed] = field(default_factory=list)

    def take(self, rows: Array, slices: Mapping[str, slice]) -> None:
        """Count the cycles of some rows of the shared memory."""
        self.cycles += len(rows)
        missed, received = (rows[:, slices[name].start] for name in ("missed", "received"))
        for row in np.flatnonzero(missed):
            self.missed.append((float(received[row]), int(missed[row])))

    def share(self, counted: list[Missed]) -> float:
        """Return the share that some of the missed cycles have of all, in percent."""
        all_missed = sum(count for _, count in self.missed)
        return 100.0 * sum(count for _, count in counted) / max(self.cycles + all_missed, 1)


def soak(
    link: str, rate: float | None, minutes: float, every: float, seed: int, folder: Path,
    severe: float,
) -> tuple[Rig, Quiet, Memory, dict[str, int]]:  # fmt: skip
    """Make a fault every ``every`` s for ``minutes``; ``severe``: share that restarts processes."""
    draw, memory, quiet = random.Random(seed), Memory(), Quiet()
    made: dict[str, int] = {}
    rows = [row for row in rows_of(link) if row.inject is not None]
    with Rig(LINKS[link](rate), folder, RECORDED) as rig:
        begun = time.monotonic()
        reader = rig.run.memory.reader()
        while time.monotonic() - begun < 60.0 * minutes:
            rig.compensate()
            rig.pass_time(QUIET)
            reader.drain()
            until, looked = time.monotonic() + draw.uniform(0.5, 1.5) * every, 0.0
            while time.monotonic() < until:
                rig.pass_time(0.1)
                quiet.take(reader.drain(), rig.run.memory.slices)
                if time.monotonic() - looked > SAMPLE:
                    looked = time.monotonic()
                    memory.look(rig, begun)
            choice = [row for row in rows if row.slow == (draw.random() < severe)] or rows
            row = draw.choice(choice)
            assert row.inject is not None
            with contextlib.suppress(OSError):  # a controller that stands still does not obey
                row.inject(rig)
            made[row.key] = made.get(row.key, 0) + 1
            rig.pass_time(min(row.lasting, 0.5))
        rig.recover()
        rig.check()
    return rig, quiet, memory, made


def missed_of(quiet: Quiet, stalls: MachineStalls, cycle: float) -> str:
    """Return in words how many cycles were missed, and how many of them the machine itself took."""
    message = f"{quiet.share(quiet.missed):.3f} % missed"
    if stalls.spans is None:
        return message
    own = quiet.share(stalls.not_among(quiet.missed, cycle))
    return f"{message} ({own:.3f} % while a bare timer on each core was on time)"


RECORDED = LIMITS.replace("folder: null", "folder: recordings")


@click.command()
@click.option("--link", type=click.Choice(list(LINKS)), default="ur_servoj", show_default=True)
@click.option("--rate", type=float, help="Hz; left out: the link's usual one.")
@click.option("--minutes", default=10.0, show_default=True)
@click.option("--every", default=3.0, show_default=True, help="s between two faults, on average.")
@click.option("--severe", default=0.03, show_default=True, help="Share that restarts processes.")
@click.option("--seed", default=1, show_default=True)
@click.option("--page", is_flag=True, help="Add a line to docs/reliability.md.")
def main(
    link: str, rate: float | None, minutes: float, every: float, severe: float, seed: int,
    page: bool,
) -> None:  # fmt: skip
    """Make faults every few seconds, and see that nothing grows, is missed or gets out."""
    folder = Path(tempfile.mkdtemp(prefix="soak-"))
    with MachineStalls() as stalls:
        rig, quiet, memory, made = soak(link, rate, minutes, every, seed, folder, severe)
    lost = missed_of(quiet, stalls, 1.0 / rig.link.rate)
    found, bounds = rig.checker.found, rig.checker.bounds
    slope, size, span = memory.slope("loop")
    step = f"{1e6 * found.largest_step:.0f}"
    click.echo(
        f"{rig.link.name}, {rig.link.rate:g} Hz, {minutes:g} min, {sum(made.values())} faults"
    )
    click.echo(f"  {found.frames} frames written, {found.writes} setpoints, {found.violated} wrong")
    click.echo(f"  largest offset {1e3 * found.largest_offset:.3f} mm, largest step {step} um")
    click.echo(f"  oldest state behind a setpoint {1e3 * found.oldest_state:.1f} ms")
    click.echo(f"  of {quiet.cycles} cycles outside faults, {lost}")
    click.echo(f"  loop: {size:.0f} MB, {slope:+.2f} MB a minute over {span:.0f} s")
    for name in sorted({name.split()[0] for name in memory.points} - {"loop"}):
        slope, size, span = memory.slope(name)
        click.echo(f"  {name}: {size:.0f} MB, {slope:+.2f} MB a minute over {span:.0f} s")
    for message in found.violations[:20]:
        click.echo(f"  VIOLATION: {message}")
    if page:
        slope, size, span = memory.slope("loop")
        allowed = 1e6 * bounds.offset_rate * bounds.cycle
        fill(PAGE, f"soak {rig.link.rate:g}", (
            f"- **{rig.link.rate:g} Hz**, {rig.link.name}, {minutes:g} minutes: "
            f"{sum(made.values())} faults, {found.frames} frames written, "
            f"{found.violated or 'no'} violations; largest step {step} µm ({allowed:.0f} a cycle); "
            f"of the cycles outside faults, {lost}; the loop's memory {slope:+.2f} MB a minute."
        ))  # fmt: skip
    sys.exit(1 if found.violated else 0)


if __name__ == "__main__":
    main()
