"""A controller that misbehaves while the daemon connects: one clear error, in bounded time."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.faults.links import CONNECT, LINKS
from benchmarks.faults.mischief import Mischief, Outcome, changing, losing
from benchmarks.faults.proxy import DOWN
from benchmarks.faults.rig import Rig
from benchmarks.faults.running import Running
from gapbridge.core.errors import LinkError

pytestmark = pytest.mark.slow
STARTING = 60.0  # s that a busy machine takes for imports and compilation


class Starting(Rig):
    """A rig whose daemon is started on a wire that is ruined already, and not waited for."""

    harm: Callable[[Rig], object]
    ruined: list[bytes]

    def start_daemon(self) -> None:
        self.harm(self)
        self._runs.append(Running(self.cell))
        self.run.start()


def answers(kind: bytes, mischief: Mischief) -> Callable[[Rig], object]:
    """Do something to the controller's answers of one RTDE type, and keep them in ``ruined``."""

    def harm(rig: Rig) -> None:
        def ruin(message: bytes) -> Outcome:
            if message[2:3] != kind:
                return [(0.0, message)]
            assert isinstance(rig, Starting)
            rig.ruined.append(message)
            return mischief(message)

        rig.proxy.do(DOWN, ruin, rig.link.main)

    return harm


refusing = changing(lambda message: message[:3] + b"\x00" + message[4:])
HARMS: dict[str, Callable[[Rig], object]] = {
    "nobody listens": lambda rig: rig.proxy.refuse(),
    "nobody answers": lambda rig: rig.proxy.mute(),
    "no answer to V": answers(b"V", losing),
    "no answer to v": answers(b"v", losing),
    "no answer to O": answers(b"O", losing),
}
HARMLESS: dict[str, Callable[[Rig], object]] = {  # the library goes on, and data come
    "no answer to S": answers(b"S", losing),
    "V refused": answers(b"V", refusing),
    "S refused": answers(b"S", refusing),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_a_bad_answer_is_none_where_data_come(tmp_path: Path, name: str) -> None:
    rig = Starting(LINKS["ur_servoj"](125.0), tmp_path)
    rig.harm, rig.ruined = HARMLESS[name], []
    with rig:
        until = time.monotonic() + STARTING
        while "connected" not in rig.run.last_words() and time.monotonic() < until:
            assert rig.run.alive, rig.run.error
            time.sleep(0.05)
        assert "DISCONNECTED -> OBSERVING (connected)" in rig.run.last_words()
        assert rig.ruined
        assert rig.found.writes == 0


@pytest.mark.parametrize("name", HARMS)
def test_a_start_that_cannot_succeed_ends_with_one_line(tmp_path: Path, name: str) -> None:
    rig = Starting(LINKS["ur_servoj"](125.0), tmp_path)
    rig.harm, rig.ruined = HARMS[name], []
    with rig:
        until = time.monotonic() + STARTING + CONNECT
        while rig.run.alive and time.monotonic() < until:
            time.sleep(0.05)
        assert isinstance(rig.run.error, LinkError), rig.run.last_words()
        assert "\n" not in str(rig.run.error)
        assert rig.found.writes == 0
        assert rig.ruined or name.startswith("nobody")  # the library has asked for it
