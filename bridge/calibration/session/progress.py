"""How far a session has come, and how long it will still take."""

from __future__ import annotations

from statistics import median

from gapbridge.bridge.calibration.format import duration
from gapbridge.bridge.calibration.session.session import Session

FIRST = 60.0  # s a stop, before anyone knows
PAUSE = 600.0  # s: a longer time between two readings was a pause
WIDTH = 16  # characters of the whole bar


def seconds_left(session: Session, minutes_per_load: float) -> float:
    """Return s until the last stop, by the readings so far."""
    paces = [s for s in session.seconds if s < PAUSE][-20:]
    done = {t.stop for t in session.taken} | session.skipped
    blocks = {(p.station, p.load) for i, p in enumerate(session.stops) if i not in done}
    changes = len(blocks - {(session.place, session.mounted)})
    return session.left * (median(paces) if paces else FIRST) + changes * 60.0 * minutes_per_load


def header(session: Session, stop: int, minutes_per_load: float) -> str:
    """Return the line above a stop."""
    count, done = len(session.stops), len(session.stops) - session.left
    pose = session.stops[stop]
    drawn = "█" * round(done / count * WIDTH)
    more = [f"place {pose.station + 1}"] if any(p.station for p in session.stops) else []
    if pose.repeat:
        first = next(i for i, p in enumerate(session.stops) if p.number == pose.number)
        more.append(f"stop {first + 1} once more")
    if pose.held_out:
        more.append("to verify, not fitted")
    return " · ".join(
        [f"{drawn:░<{WIDTH}} stop {stop + 1} of {count}", f"load {pose.load + 1}", *more,
         f"{duration(seconds_left(session, minutes_per_load))} left"]
    )  # fmt: skip
