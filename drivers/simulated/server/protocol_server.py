"""Running an ArmController with its protocol servers and the bench: one select() loop."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import select
import socket
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.bench import BenchServer, Command
from gapbridge.drivers.simulated.server.connection import Connection, listen

if TYPE_CHECKING:
    from _typeshed import HasFileno

SET_TIMER_SLACK = 29  # prctl's PR_SET_TIMERSLACK
SLACK = 1000  # ns; Linux otherwise ends timeouts up to 50 us late
PRIORITY = 40  # SCHED_FIFO, of 1 to 99; about 7 % of one core is used
LATE = 0.1  # s: behind by more than this, the missed cycles are left out
COLLECT_EVERY = 2.0  # s


class ProtocolServer:
    """One protocol of a controller. Its loop calls every method; none may block."""

    name = "server"

    def open(self, controller: ArmController, clock: Clock) -> None:
        """Open ports; ``clock`` is for what does not go by cycles. Raises OSError or LinkError."""

    def cycle(self, controller: ArmController) -> None:
        """Read what clients have sent, command the arm, publish its state; after each cycle."""

    def sockets(self) -> Iterable[HasFileno]:
        """Return the sockets to wait for between cycles; none if ``cycle`` polls."""
        return ()

    def serve(self, ready: HasFileno, controller: ArmController) -> None:
        """Serve one of ``sockets()`` that is readable."""

    def commands(self, controller: ArmController) -> Mapping[str, Command]:
        """Return further bench commands, for faults of this protocol."""
        return {}

    def drop(self) -> None:
        """Close every client's connection."""

    def close(self) -> None:
        """Close everything; may be repeated."""


class ServerLoop:
    """A controller with its servers and its bench port, cycled at absolute deadlines."""

    def __init__(
        self,
        controller: ArmController,
        servers: Sequence[ProtocolServer],
        host: str,
        bench_port: int,
        clock: Clock,
    ) -> None:
        self._clock = clock
        self.controller, self.servers, self.host = controller, servers, host
        self._port = bench_port
        self._listener: socket.socket | None = None
        self._clients: list[Connection] = []
        commands: dict[str, Command] = {}
        for server in servers:
            commands.update(server.commands(controller))
        self._bench = BenchServer(controller, self._drop, controller.move_own, commands)

    @property
    def bench_port(self) -> int:
        """Return the port of the bench, once open."""
        return int(self._listener.getsockname()[1]) if self._listener else self._port

    def open(self) -> None:
        """Open every port. Raises LinkError if one is taken."""
        try:
            self._listener = listen(self.host, self._port)
            for server in self.servers:
                server.open(self.controller, self._clock)
        except OSError as error:
            self.close()
            raise LinkError(
                f"simulated controller on {self.host}: {error.strerror or error}"
            ) from None
        except LinkError:
            self.close()
            raise

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve until `stop()` is true; it is asked once per cycle."""
        controller, clock = self.controller, self._clock
        deadline = clock.monotonic()
        while not stop():
            deadline += controller.period
            self._serve_until(deadline)
            now = clock.monotonic()
            if now - deadline > LATE:
                deadline = now
            controller.cycle()
            for server in self.servers:
                server.cycle(controller)
            controller.sensors.after_cycle(controller.clock)

    def _serve_until(self, deadline: float) -> None:
        while True:
            remaining = deadline - self._clock.monotonic()
            owners = {s.fileno(): (server, s) for server in self.servers for s in server.sockets()}
            clients = {c.fileno(): c for c in self._clients}
            listener = [self._listener.fileno()] if self._listener else []
            ready, _, _ = select.select([*listener, *clients, *owners], [], [], max(remaining, 0.0))
            for number in ready:
                if number in owners:
                    server, waited = owners[number]
                    server.serve(waited, self.controller)
                elif number in clients:
                    clients[number].read()
                    self._bench.handle(clients[number])
                else:
                    self._accept()
            self._clients = [c for c in self._clients if c.open]
            if remaining <= 0.0 or not ready:
                return

    def _accept(self) -> None:
        assert self._listener is not None
        with contextlib.suppress(OSError):
            self._clients.append(Connection(self._listener.accept()[0]))

    def _drop(self) -> None:
        for server in self.servers:
            server.drop()

    def close(self) -> None:
        """Close every port; may be repeated."""
        for server in self.servers:
            server.close()
        for client in self._clients:
            client.close()
        if self._listener is not None:
            self._listener.close()
            self._listener = None


def serve_controller(
    controller: ArmController,
    servers: Sequence[ProtocolServer],
    host: str,
    bench_port: int,
    clock: Clock,
    stop: Callable[[], bool] | None = None,
) -> None:
    """Serve a controller in this process until `stop()` is true (never, if it is None).

    Prints ``ready <host>`` to stdout when every port listens. Raises LinkError where one is taken.
    """
    loop = ServerLoop(controller, servers, host, bench_port, clock)
    loop.open()
    become_punctual()  # from here on nothing is collected by itself
    collected = clock.monotonic()

    def over() -> bool:
        nonlocal collected
        if (now := clock.monotonic()) - collected > COLLECT_EVERY:
            collected = now
            gc.collect(1)
        return stop is not None and stop()

    sys.stdout.write(f"ready {host}\n")
    sys.stdout.flush()
    try:
        loop.run(over)
    finally:
        loop.close()


def become_punctual() -> None:
    """Sharpen this thread's timers, take real-time priority where it is allowed, tame collection.

    Afterwards nothing is collected by itself: the caller collects young objects in its slack.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(SET_TIMER_SLACK, SLACK, 0, 0, 0)
    gc.collect()
    gc.freeze()
    gc.disable()
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
