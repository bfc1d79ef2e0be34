"""Moments in sessions whose clocks overlap: told by the first session that has rows after them.

Such sessions are joined one after the other on a clock that is none of theirs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from gapbridge.core.diagnosis.across_sessions import SessionTransfer
from gapbridge.core.diagnosis.causes import Cause
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.effects import Reported
from gapbridge.core.log.log import Log
from gapbridge.core.sessions import session_of


def first_session(moment: float, log: Log) -> str:
    """Return the name of the first session with rows after ``moment``, s of the joined clock."""
    session, after = session_of(log), log.times() > moment
    return log.session_names[int(session[after].min() if after.any() else session.max())]


def on_own_clocks(channel: ChannelDiagnosis, log: Log) -> ChannelDiagnosis:
    """Return a channel's diagnosis whose moments are of the sessions' own clocks.

    Where these overlap, a moment has no value (nan), but the first session after it.
    """
    if log.one_clock:
        return channel

    def with_session(parameters: Iterable[Reported]) -> tuple[Reported, ...]:
        return tuple(
            replace(p, value=float("nan"), std=None, session=first_session(p.value, log))
            if p.is_time else p
            for p in parameters
        )  # fmt: skip

    def causes(some: Iterable[Cause]) -> tuple[Cause, ...]:
        return tuple(replace(cause, parameters=with_session(cause.parameters)) for cause in some)

    def transfer(one: SessionTransfer) -> SessionTransfer:
        return replace(one, values=tuple((s, with_session(p)) for s, p in one.values))

    return replace(
        channel, causes=causes(channel.causes), stand_ins=causes(channel.stand_ins),
        session_transfer=tuple(transfer(one) for one in channel.session_transfer),
    )  # fmt: skip
