"""The server process: one select() loop with absolute deadlines that serves every port."""

from __future__ import annotations

import gc
import logging
import select
import socket
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.server.bench import BenchServer
from gapbridge.drivers.simulated.server.connection import Connection, listen
from gapbridge.drivers.simulated.server.protocol_server import become_punctual
from gapbridge.drivers.simulated.ur.controller import CYCLE, Controller
from gapbridge.drivers.simulated.ur.programs.script_programs import move_own
from gapbridge.drivers.simulated.ur.servers.dashboard_server import DashboardServer
from gapbridge.drivers.simulated.ur.servers.primary_server import PrimaryServer
from gapbridge.drivers.simulated.ur.servers.rtde_server import RtdeServer, RtdeSession
from gapbridge.drivers.simulated.ur.servers.script_server import ScriptServer
from gapbridge.drivers.simulated.ur.settings import ServerSettings, make_controller

log = logging.getLogger("drivers.simulated")

LEAD = 0.0002  # s by which a cycle is computed before its packets are due, so that they are on time
COLLECT_EVERY = 500  # cycles
LATE = 0.1  # s: behind by more than this, the missed cycles are left out


Accept = Callable[[socket.socket], Connection]
Handle = Callable[[Connection], None]


class Server:
    """All ports of one controller on one loopback address."""

    def __init__(self, settings: ServerSettings, clock: Clock) -> None:
        self._now = clock.monotonic
        self.controller: Controller = make_controller(settings)
        version = ".".join(str(v) for v in (*settings.version, 0))
        self.rtde = RtdeServer(self.controller, (*settings.version, 0))
        self._dashboard = DashboardServer(self.controller, version, settings.serial)
        self._script = ScriptServer(self.controller)
        self._primary = PrimaryServer(
            self.controller, settings.version, settings.nominal, settings.calibrated
        )
        self._bench = BenchServer(
            self.controller, self.rtde.close_all, partial(move_own, self.controller)
        )
        self._clients: dict[socket.socket, tuple[Connection, Handle]] = {}
        self._listeners: dict[socket.socket, tuple[Accept, Handle]] = {}
        self._open_ports(settings)

    def _open_ports(self, settings: ServerSettings) -> None:
        host = settings.host
        try:
            self._add(listen(host, settings.rtde_port), self.rtde.accept, self._handle_rtde)
            self._add(listen(host, settings.dashboard_port), self._greeted, self._dashboard.handle)
            self._add(listen(host, settings.script_port), Connection, self._script.handle)
            self._add(
                listen(host, settings.primary_port), self._primary.accept, self._script.handle
            )
            self._add(listen(host, settings.bench_port), Connection, self._bench.handle)
        except OSError as error:
            self.close()
            raise LinkError(f"simulated controller on {host}: {error.strerror or error}") from error

    def _add(self, sock: socket.socket, accept: Accept, handle: Handle) -> None:
        self._listeners[sock] = accept, handle

    def _greeted(self, sock: socket.socket) -> Connection:
        connection = Connection(sock)
        self._dashboard.greet(connection)
        return connection

    def _handle_rtde(self, connection: Connection) -> None:
        if isinstance(connection, RtdeSession):
            self.rtde.handle(connection)

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until `stop()` is true; it is asked once per cycle."""
        controller, rtde = self.controller, self.rtde
        deadline = self._now()
        cycles = 0
        while not stop():
            self._serve_until(deadline + 0.5 * CYCLE)
            deadline += CYCLE
            controller.sensors.after_cycle(controller.clock)  # costly, so half a cycle off
            cycles += 1
            if cycles % COLLECT_EVERY == 0:
                gc.collect(1)
            self._serve_until(deadline - LEAD)
            controller.cycle()
            self._serve_until(deadline)
            now = self._now()
            if now - deadline > LATE:
                deadline = now
            rtde.publish(CYCLE)
            self._primary.publish()

    def _serve_until(self, deadline: float) -> None:
        """Answer clients until the next cycle is due."""
        while True:
            remaining = deadline - self._now()
            watched = [*self._listeners, *self._clients]
            try:
                ready, _, _ = select.select(watched, [], [], max(remaining, 0.0))
            except (OSError, ValueError):
                self._forget_closed()
                continue
            for sock in ready:
                self._serve(sock)
            self._forget_closed()
            if remaining <= 0.0 or not ready:
                return

    def _serve(self, sock: socket.socket) -> None:
        listener = self._listeners.get(sock)
        if listener is not None:
            try:
                accepted, _ = sock.accept()
            except OSError:
                return
            accept, handle = listener
            self._clients[accepted] = accept(accepted), handle
            return
        connection, handle = self._clients[sock]
        connection.flush()
        connection.read()
        try:
            handle(connection)
        except Exception:
            log.exception("a client's request failed; its connection is closed")
            connection.close()

    def _forget_closed(self) -> None:
        closed = [sock for sock, (connection, _) in self._clients.items() if not connection.open]
        for sock in closed:
            del self._clients[sock]
        self.rtde.drop_closed()

    def close(self) -> None:
        """Close every socket."""
        for connection, _ in self._clients.values():
            connection.close()
        for sock in self._listeners:
            sock.close()


Beside = Callable[[Callable[[], Sequence[float]]], AbstractContextManager[None]]
"""Serves a flange sensor while its context lasts, given the wrench (6,) on the flange."""


def serve(
    settings: ServerSettings,
    clock: Clock,
    stop: Callable[[], bool] | None = None,
    beside: Beside = lambda _: nullcontext(),
) -> None:
    """Serve a simulated controller until `stop()` is true (never, if it is None).

    ``beside`` serves what else feels the plant. Prints ``ready <host>`` to stdout when every port
    listens. Raises LinkError where a port is taken. Must run in a process of its own: ur_rtde's
    constructors hold the interpreter lock.
    """
    server = Server(settings, clock)
    memory = server.controller.memory
    try:
        with beside(lambda: memory["ft_raw_wrench"]):
            become_punctual()
            sys.stdout.write(f"ready {settings.host}\n")
            sys.stdout.flush()
            server.run(stop or (lambda: False))
    finally:
        server.close()
