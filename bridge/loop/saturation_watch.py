"""An offset that stands at its limit: the model wants more than it may have."""

from __future__ import annotations

from gapbridge.core.limits import ENVELOPE, JOINT_LIMIT, JOINT_OFFSET

LONGEST = 1.0  # s
_AT_LIMIT = 1 << ENVELOPE | 1 << JOINT_OFFSET | 1 << JOINT_LIMIT


class SaturationWatch:
    """Watches the limiter's bits."""

    def __init__(self) -> None:
        self._since: float | None = None

    def update(self, now: float, clamped: int) -> str | None:
        """Return in words that the offset has stood at a limit for too long."""
        if not clamped & _AT_LIMIT:
            self._since = None
            return None
        if self._since is None or now < self._since:
            self._since = now
        if now - self._since <= LONGEST:
            return None
        return f"the offset has been held back by its limits for {now - self._since:.2f} s"
