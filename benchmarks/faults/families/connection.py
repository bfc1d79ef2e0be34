"""The connection ends: reset, closed, the controller dead and back."""

from __future__ import annotations

from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, seconds


def _kill(rig: Rig) -> None:
    rig.controller.kill()
    rig.proxy.refuse()


def _refuse(rig: Rig) -> None:
    rig.proxy.refuse()
    rig.proxy.cut()


def _mute(rig: Rig) -> None:
    rig.proxy.mute()
    rig.proxy.cut()


AT_ONCE = seconds(0.3)  # the library says so in its own time; a busy machine takes some more

ROWS = (
    Row("reset", "TCP RST", "proxy resets every connection", lambda rig: rig.proxy.cut(),
        within=AT_ONCE, slow=True),
    Row("end of file", "TCP EOF", "proxy closes every connection",
        lambda rig: rig.proxy.cut(reset=False), within=AT_ONCE, slow=True),
    Row("peer dies", "server restart, CAN peer death", "SIGKILL of the controller, started anew",
        _kill, within=AT_ONCE, lasting=0.5, slow=True),
    Row("peer refuses", "connection refused", "proxy cuts and refuses for 1.5 s",
        _refuse, within=AT_ONCE, lasting=1.5,
        slow=True),
    Row("peer is mute", "no answer to a new connection", "proxy cuts, then says nothing for 2 s",
        _mute, within=AT_ONCE, lasting=2.0,
        slow=True),
)  # fmt: skip
