"""What a run reports at its end."""

from __future__ import annotations

from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import Found
from gapbridge.bridge.fleet.task import BAD, CRASHED, DIED, DONE

STATES = {
    BAD: "cannot be used",
    CRASHED: "failed",
    DIED: "killed their workers",
}


def ending(done: Done, found: Found) -> list[str]:
    """Return the lines: how many, whose, by whom, how long; what was skipped."""
    states = [o.state for o in done.outcomes]
    fresh = len(states) - done.resumed
    lines = [
        f"{counted(len(states), 'session')} of {counted(found.arms, 'arm')} ({found.rule}): "
        f"{states.count(DONE)} done"
        + "".join(f", {states.count(s)} {w}" for s, w in STATES.items() if s in states)
    ]
    if done.resumed:
        lines.append(f"{done.resumed} of them known from an earlier run")
    if fresh:
        lines.append(f"{done.seconds:.1f} s by {done.who}")
    return lines


def counted(number: int, word: str) -> str:
    """Return "1 arm" or "2 arms"."""
    return f"{number} {word}{'' if number == 1 else 's'}"
