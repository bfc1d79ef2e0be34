"""Six CiA 402 drives of an LWA 4P: SYNC, their TPDOs, six RPDOs, beside canopen alone.

Both sides use one canopen network with its notifier thread, whose CPU time counts, and the same
enabled drives. In our turn the network feeds our listener, in the library's its own, with its PDO
maps subscribed; the library reads the same objects from them and writes the same ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from canopen.network import MessageListener

from benchmarks.links.case import Cycles, OurCycle, Pause
from gapbridge.bridge.cell.cell import Cell
from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.clock import SYSTEM

HOST, PORT = "127.77.0.3", 29920
PACE = 0.010  # s from one SYNC to the next, as the drives are configured
COMMON = (
    "profile: lwa4p, rate: 100, state_timeout: 0.5, listen: 0.05, foreign_quiet: 0.1,"
    " frozen_after: 10.0"
)
HUB = f"link: {{driver: canopen, {COMMON}, interface: socketcand, host: {HOST}, port: {PORT}}}\n"
VIRTUAL = f"link: {{driver: canopen, {COMMON}, interface: virtual, channel: drive-costs}}\n"


@contextmanager
def armed(cell: Cell, pause: Pause) -> Iterator[Cycles]:
    """Yield the two sides of a served cell."""
    assert isinstance(cell.link, CanopenSettings)
    with CanopenDriver(cell.link, cell.model, SYSTEM) as driver:
        ours = OurCycle(driver, cell.model)
        driver.arm(driver.read_state())
        ours.hold = driver.writer.target
        yield _Sides(driver, ours, pause).cycles()


class _Sides:
    """The two ways to use one network."""

    def __init__(self, driver: CanopenDriver, ours: OurCycle, pause: Pause) -> None:
        self._driver, self._ours, self._pause = driver, ours, pause
        network = driver.master.network
        self._network = network
        self._listeners = ([driver.master.listener], [MessageListener(network)])
        self._come, self._missing = threading.Event(), 0
        self._due = 0.0
        profile = driver.profile
        assert ours.hold is not None
        counts = profile.counts(ours.hold)
        self._tpdo: list[Any] = []
        self._read: list[Any] = []
        self._rpdo: list[tuple[Any, list[tuple[Any, int]]]] = []
        for joint, node in enumerate(profile.nodes):
            remote = network[node]
            remote.tpdo.read()
            remote.rpdo.read()
            for layout in profile.tpdo:
                pdo = remote.tpdo[layout.number]
                pdo.add_callback(self._count)
                self._tpdo.append(pdo)
                self._read += list(pdo.map)
            for layout in profile.rpdo:
                image = {**driver.writer._image[joint], profile.target: int(counts[joint])}
                values = [image[entry.name] for entry in layout.entries]
                pdo = remote.rpdo[layout.number]
                self._rpdo.append((pdo, list(zip(pdo.map, values, strict=True))))

    def cycles(self) -> Cycles:
        """Return both sides."""
        readers = [thread.ident for thread in self._network.notifier._readers]
        library = (self._library_read, self._library_write)
        return Cycles(self._ours.steps, library, self._wait, self._turn, tuple(readers))

    def _turn(self, is_ours: bool) -> None:
        time.sleep(0.02)  # until what is under way has come
        self._network.listeners[:] = self._listeners[not is_ours]
        for pdo in self._tpdo:
            self._network.subscribers.pop(pdo.cob_id, None)
            if not is_ours:
                pdo.subscribe()
        self._driver.sync_cycle._torn = False
        self._driver.master.collector.clear_stray()

    def _wait(self) -> None:
        self._due = max(self._due + PACE, time.monotonic())
        self._pause(max(self._due - time.monotonic(), 0.0))
        self._driver.master.beat()  # else the drives miss our heartbeat in the library's turn
        self._driver.sync_cycle._due = 0.0  # no pacing inside the cycle

    def _count(self, _: Any) -> None:
        self._missing -= 1
        if self._missing == 0:
            self._come.set()

    def _library_read(self) -> None:
        self._missing = len(self._tpdo)
        self._come.clear()
        self._network.sync.transmit()
        self._come.wait(0.05)
        for variable in self._read:
            _ = variable.raw

    def _library_write(self) -> None:
        for pdo, values in self._rpdo:
            for variable, value in values:
                variable.raw = value
            pdo.transmit()
