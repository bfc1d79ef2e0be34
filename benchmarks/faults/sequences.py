"""Random sequences of faults: several in a row, overlapping, healed or not, and then recovered.

Nothing is expected of the states in between but that the invariants hold on every frame, and that
the daemon comes back to compensating once a person has healed and armed it again.
"""

from __future__ import annotations

import contextlib
import json
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from benchmarks.faults.links import LINKS
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row
from benchmarks.faults.table import rows_of

LONGEST = 4  # faults of a sequence
LONGEST_WAIT = 0.25  # s between two of them
KEPT = "sequences.json"
TOGETHER = 40  # sequences on one rig
SEVERE = 0.04  # share of faults that end the loop's process or the controller: they take seconds


@dataclass
class Tally:
    """What came of random sequences, by link."""

    sequences: dict[str, int] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    writes: dict[str, int] = field(default_factory=dict)
    largest_step: dict[str, float] = field(default_factory=dict)
    largest_offset: dict[str, float] = field(default_factory=dict)
    violations: dict[str, list[str]] = field(default_factory=dict)
    violated: int = 0
    stuck: int = 0

    def add(self, other: Tally) -> None:
        """Take another tally's links in; each link is in one of them only."""
        for key in ("sequences", "faults", "frames", "writes"):
            mine, theirs = getattr(self, key), getattr(other, key)
            mine.update({name: mine.get(name, 0) + count for name, count in theirs.items()})
        for key in ("largest_step", "largest_offset"):
            mine, theirs = getattr(self, key), getattr(other, key)
            mine.update({name: max(mine.get(name, 0.0), most) for name, most in theirs.items()})
        for name, message in other.violations.items():
            self.violations[name] = [*self.violations.get(name, []), *message]
        self.violated += other.violated
        self.stuck += other.stuck

    def message(self) -> str:
        """Return it in one line."""
        return (
            f"{sum(self.sequences.values())} sequences of {sum(self.faults.values())} faults, "
            f"{sum(self.frames.values())} frames written, {self.violated} violations, "
            f"{self.stuck} did not recover"
        )

    def table(self) -> str:
        """Return it as a table, a line for each link."""
        lines = [
            "| link | sequences | faults | frames written | setpoints | largest offset, mm | "
            "largest step, µm | violations |",
            "| --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        lines += [
            f"| {LINKS[name].name} | {count} | {self.faults[name]} | {self.frames[name]} | "
            f"{self.writes[name]} | {1e3 * self.largest_offset[name]:.3f} | "
            f"{1e6 * self.largest_step[name]:.0f} | {len(self.violations[name]) or 'none'} |"
            for name, count in self.sequences.items()
        ]
        if self.stuck:
            lines += [
                "",
                f"{self.stuck} sequences did not come back to compensating by themselves.",
            ]
        return "\n".join(lines)


def run_sequences(
    links: Sequence[str], count: int, seed: int, folder: Path, rate: float | None,
    say: Callable[[str], None], limit: float,
) -> Tally:  # fmt: skip
    """Run ``count`` sequences, shared out over the links; the same seed draws the same ones."""
    tally, until = Tally(), time.monotonic() + limit
    for i, name in enumerate(links):
        share = count // len(links) + (i < count % len(links))
        link = LINKS[name](rate if name.startswith("ur_") else None)
        draw = random.Random(f"{seed} {name}")
        done = 0
        tally.sequences[name] = tally.faults[name] = tally.frames[name] = tally.writes[name] = 0
        tally.largest_step[name] = tally.largest_offset[name] = 0.0
        tally.violations[name] = []
        while done < share and time.monotonic() < until:
            with Rig(link, folder / f"sequences-{name}") as rig:
                done = _on_rig(rig, name, done, share, draw, tally, until, say)
                _add(tally, name, rig)
            (folder / KEPT).write_text(json.dumps(asdict(tally)), encoding="utf-8")
    return tally


def read_tally(folder: Path) -> Tally:
    """Return what a run has kept in its folder."""
    return Tally(**json.loads((folder / KEPT).read_text(encoding="utf-8")))


def _on_rig(
    rig: Rig, name: str, done: int, share: int, draw: random.Random, tally: Tally,
    until: float, say: Callable[[str], None],
) -> int:  # fmt: skip
    """Run sequences until all are done or the rig is beyond recovery; returns how many are."""
    last = min(share, done + TOGETHER)
    while done < last and time.monotonic() < until:
        chosen = draw_sequence(draw, name)
        before, begun = rig.found.violated, time.monotonic()
        try:
            tally.faults[name] += make_sequence(rig, chosen)
        except Exception as error:
            tally.stuck += 1
            say(f"{name}: {[row.key for row, _ in chosen]}: {type(error).__name__}: {error}")
            if rig.run.error is not None or not rig.run.alive:
                done += 1
                break
        done += 1
        tally.sequences[name] = done
        new = rig.found.violated - before
        if new or done % 25 == 0:
            keys = ", ".join(row.key for row, _ in chosen)
            say(f"{name}: {done} of {share}, {time.monotonic() - begun:.1f} s ({keys})")
        for message in rig.checker.found.violations[-new:] if new else ():
            say(f"    VIOLATION: {message}")
    return done


def make_sequence(rig: Rig, chosen: Sequence[tuple[Row, float]]) -> int:
    """Make faults in a row while the daemon compensates, and recover; returns how many."""
    rig.compensate()
    made = 0
    for row, wait in chosen:
        assert row.inject is not None
        with contextlib.suppress(OSError):  # a controller that stands still does not obey
            row.inject(rig)
            made += 1
        rig.pass_time(wait)
    rig.recover()
    return made


def draw_sequence(
    draw: random.Random, link: str, severe: float = SEVERE
) -> list[tuple[Row, float]]:
    """Return rows and how long to wait after each, s; ``severe``: share that restarts processes."""
    rows = [row for row in rows_of(link) if row.inject is not None]
    quick = [row for row in rows if not row.slow]
    slow = [row for row in rows if row.slow]
    return [
        (
            draw.choice(slow if slow and draw.random() < severe else quick),
            draw.uniform(0.0, LONGEST_WAIT),
        )
        for _ in range(draw.randint(1, LONGEST))
    ]


def _add(tally: Tally, name: str, rig: Rig) -> None:
    found = rig.found
    tally.frames[name] += found.frames
    tally.writes[name] += found.writes
    tally.largest_step[name] = max(tally.largest_step[name], found.largest_step)
    tally.largest_offset[name] = max(tally.largest_offset[name], found.largest_offset)
    tally.violations[name] += found.violations
    tally.violated += found.violated
