"""`back`: earlier poses measured once more show whether the instrument or the target has moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.format import millimetres
from gapbridge.bridge.calibration.session.reading import Taken
from gapbridge.core.estimation.registration import register

if TYPE_CHECKING:
    from gapbridge.bridge.calibration.session.measuring import Conversation

Array = NDArray[np.float64]
POSES = 3  # measured once more where the first of them has changed
NOISES = 6.0  # of instrument and arm: two readings of a pose differ by less
LEAST = 1.5e-4  # m
REPEATABILITY = 5e-5  # m, 1 sigma of one coordinate
PLAINER = 3.0  # times: the residual by the other story


@dataclass(frozen=True)
class Again:
    """One pose, before and now."""

    before: Taken
    now: Taken
    q: Array  # (n,)
    shift: Array  # (3,) or (k,) m, how far the reading has gone, the arm's own motion taken off


def look_back(talking: Conversation) -> None:
    """Measure an earlier pose again, further ones where it has changed, and say what moved."""
    talk, book = talking.talk, talking.book
    earlier = _earlier(talking)
    if talking.foresight is None or not talking.foresight.compares or not earlier:
        talk.say("  no earlier pose to go back to with this load, place and instrument")
        return
    limit = max(NOISES * float(np.hypot(talking.sigma, REPEATABILITY)), LEAST)
    first = len(book.taken)
    seen: list[Again] = []
    for before in earlier[:POSES]:
        talk.say(f"  back to stop {before.stop + 1}", "bold")
        seen.append(_once_more(talking, before))
        off = float(np.linalg.norm(seen[-1].shift))
        if off < limit:
            break
        talk.warn(f"stop {before.stop + 1} now reads {millimetres(off)} beside what it read before")
    if float(np.linalg.norm(seen[-1].shift)) < limit:
        talk.say(
            f"  as before, within {millimetres(limit)}: instrument and target stand where they "
            "stood; measure the doubtful pose again"
        )
        return
    _decide(talking, seen, limit, first)


def _earlier(talking: Conversation) -> list[Taken]:
    """Return good readings of different stops with what is mounted now, the newest first."""
    book, found, stops = talking.book, [], set()
    for taken in reversed(book.taken):
        same = taken.station == book.station and taken.load == book.mounted
        if same and not taken.doubted and taken.stop not in stops:
            stops.add(taken.stop)
            found.append(taken)
    return found


def _once_more(talking: Conversation, before: Taken) -> Again:
    book = talking.book
    pose = book.stops[before.stop]
    now, _ = talking.measure(before.stop, talking.bringing.bring(pose), again=True)
    book.add("reading", **now.entry())
    kind = talking.instrument.kind
    assert talking.foresight is not None
    shift = talking.foresight.shift(
        book.readings(kind, [before]), book.readings(kind, [now]),
        book.readings(kind, [t for t in book.taken[:-1] if not t.doubted]),
    )  # fmt: skip
    return Again(before, now, before.q, shift)


def _decide(talking: Conversation, seen: list[Again], limit: float, first: int) -> None:
    """Say what has moved, have the person agree, and begin a new place."""
    talk = talking.talk
    stories = _stories(talking, seen)
    answers = {"moved": "the instrument was knocked or moved: it has a new place from here on",
               "slipped": "the target slipped on the tool: it has a new place from here on",
               "keep": "neither: go on as if nothing had happened"}  # fmt: skip
    likely = ""
    if stories and min(stories.values()) * PLAINER < max(stories.values()):
        likely = min(stories, key=lambda story: stories[story])
        what = "the instrument has moved" if likely == "moved" else "the target has slipped"
        talk.say(
            f"  {what}: that leaves {millimetres(stories[likely])} unexplained, the other story "
            f"{millimetres(max(stories.values()))}"
        )
    else:
        talk.say("  these poses do not show whether instrument or target has moved; you may know")
    order = [likely, *(k for k in answers if k != likely)] if likely else list(answers)
    chosen = talk.choose("  which", {k: answers[k] for k in order})
    if chosen != "keep":
        talking.mark_moved(chosen, since=first)


def _stories(talking: Conversation, seen: list[Again]) -> dict[str, float]:
    """Return what each story leaves over, m rms: a rigid motion, or a shift in the tool's axes."""
    if len(seen) < POSES or len(seen[0].shift) < 3:
        return {}
    assert talking.foresight is not None
    poses = talking.foresight.poses(talking.book.readings(
        talking.instrument.kind, [a.now for a in seen]
    ))  # fmt: skip
    shift = np.array([a.shift[:3] for a in seen])
    there = poses.position
    frame = register(there + shift, there)
    rigid = there + shift - (there @ frame.rotation.T + frame.position)
    in_tool = np.einsum("nji,nj->ni", poses.rotation, shift)
    slip = in_tool - in_tool.mean(axis=0)
    count = shift.size  # degrees of freedom: six are spent on a motion, three on a slip
    return {
        "moved": float(np.sqrt(np.sum(rigid**2) / (count - 6))),
        "slipped": float(np.sqrt(np.sum(slip**2) / (count - 3))),
    }
