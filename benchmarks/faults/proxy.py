"""A TCP proxy between client and server that injects faults and sends a tap a copy of all.

One thread serves every port. Messages from the client are recorded before anything is done to them:
that is what was written, with the time at which the kernel had it (arrival.py). Messages to the
client are recorded as they have left: that is what it could know.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import selectors
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Self

from benchmarks.faults.arrival import note_arrivals, receive
from benchmarks.faults.mischief import Mischief, passing
from benchmarks.faults.punctual import be_punctual
from benchmarks.faults.splitting import Splitter

UP, DOWN = "up", "down"  # from the client, to the client
RESET = struct.pack("ii", 1, 0)  # SO_LINGER: closing sends RST
Emit = Callable[[float, float, int, str, str, bytes], None]
"""Between which times (s, monotonic), connection, name of the port, direction, message."""


@dataclass
class Port:
    """One port of the server: where it is, and how its messages are delimited."""

    name: str
    port: int
    splitter: type[Splitter]


@dataclass(eq=False)
class Connection:
    """One client and the controller's end that belongs to it."""

    number: int
    port: Port
    ends: dict[str, socket.socket]  # by the direction that is read from it
    splitters: dict[str, Splitter] = field(default_factory=dict)
    out: dict[str, bytearray] = field(default_factory=lambda: {UP: bytearray(), DOWN: bytearray()})
    arrived: float = 0.0  # s, monotonic: the last message of the client


class Proxy:
    """Serves ``ports`` of ``target`` at ``host`` while the ``with`` block lasts.

    ``up`` and ``down`` are done to each message, by the name of its port; ``on`` limits a mischief
    to one connection. Methods may be called from any thread.
    """

    def __init__(self, host: str, target: str, ports: Iterable[Port], emit: Emit) -> None:
        self.host, self.target, self._emit = host, target, emit
        self._ports = list(ports)
        self._mischief: dict[tuple[str, str], Mischief] = {}
        self._selector = selectors.DefaultSelector()
        self._connections: list[Connection] = []
        self._listeners: list[socket.socket] = []
        self._due: list[tuple[float, int, Connection, str, bytes]] = []
        self._order = itertools.count()
        self._numbers = itertools.count()
        self._stalled_until = 0.0
        self._mute = self._stopping = False
        self._orders: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._wake_out, self._wake_in = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="proxy", daemon=True)

    # -- harm -------------------------------------------------------------------------------------

    def do(self, direction: str, mischief: Mischief, port: str) -> None:
        """Do ``mischief`` to the messages of a direction from now on."""
        self._mischief[port, direction] = mischief

    def heal(self) -> None:
        """Do no more harm."""
        self._mischief = {}
        self._stalled_until, self._mute = 0.0, False
        self._order_thread(self._listen)

    def stall(self, seconds: float) -> None:
        """Hand nothing on for a while; all that comes leaves when it is over."""
        self._stalled_until = time.monotonic() + seconds

    def cut(self, reset: bool = True) -> None:
        """End every connection, by RST or by FIN."""
        self._order_thread(lambda: self._cut_all(reset))

    def refuse(self) -> None:
        """Listen no more: whoever comes is refused."""
        self._order_thread(self._listen_no_more)

    def mute(self) -> None:
        """Accept whoever comes and never say a word."""
        self._mute = True

    def inject(self, direction: str, port: str, data: bytes) -> None:
        """Put bytes of our own into every connection of a port."""

        def put() -> None:
            for connection in self._connections:
                if connection.port.name == port:
                    self._send(connection, direction, [data])

        self._order_thread(put)

    def _order_thread(self, order: Callable[[], None]) -> None:
        with self._lock:
            self._orders.append(order)
        with contextlib.suppress(OSError):
            os.write(self._wake_in, b".")

    # -- serving ----------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._listen()
        self._selector.register(self._wake_out, selectors.EVENT_READ, None)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._order_thread(lambda: None)
        self._thread.join(5.0)
        self._cut_all(reset=True)
        self._listen_no_more()
        self._selector.close()
        os.close(self._wake_in)
        os.close(self._wake_out)

    def _listen(self) -> None:
        if self._listeners:
            return
        for port in self._ports:
            listener = socket.create_server((self.host, port.port), backlog=16)
            listener.setblocking(False)
            self._listeners.append(listener)
            self._selector.register(listener, selectors.EVENT_READ, port)

    def _listen_no_more(self) -> None:
        for listener in self._listeners:
            self._selector.unregister(listener)
            listener.close()
        self._listeners = []

    def _serve(self) -> None:
        be_punctual()
        while not self._stopping:
            now = time.monotonic()
            wait = min(self._due[0][0] - now, 0.5) if self._due else 0.5
            ready = self._selector.select(max(wait, 0.0))
            # what was written goes first: it cannot be an answer to what is handed on now
            for key, _ in sorted(ready, key=_comes_last):
                if key.fileobj == self._wake_out:
                    os.read(self._wake_out, 64)
                elif isinstance(key.data, Port):
                    self._accept(key.fileobj, key.data)
                else:
                    self._read(*key.data)
            self._take_orders()
            self._send_due()

    def _take_orders(self) -> None:
        with self._lock:
            orders, self._orders = self._orders, []
        for order in orders:
            order()

    def _accept(self, listener: object, port: Port) -> None:
        assert isinstance(listener, socket.socket)
        try:
            client, _ = listener.accept()
        except OSError:
            return
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        note_arrivals(client)
        ends = {UP: client}
        if not self._mute:
            try:
                real = socket.create_connection((self.target, port.port), timeout=2.0)
            except OSError:
                self._close(client, reset=True)
                return
            real.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            ends[DOWN] = real
        connection = Connection(next(self._numbers), port, ends)
        for direction, end in ends.items():
            end.setblocking(False)
            connection.splitters[direction] = port.splitter()
            self._selector.register(end, selectors.EVENT_READ, (connection, direction))
        self._connections.append(connection)

    def _read(self, connection: Connection, direction: str) -> None:
        if connection not in self._connections:
            return
        try:
            data, arrived = receive(connection.ends[direction])
        except BlockingIOError:
            return
        except OSError:
            data, arrived = b"", 0.0
        if not data:
            self._drop(connection, reset=False)
            return
        self._send_due()  # what was held back goes first
        port, now = connection.port.name, time.monotonic()
        messages = connection.splitters[direction].feed(data)
        at_once: list[bytes] = []
        for i, message in enumerate(messages):
            if direction == UP:
                # the kernel knows the time of the last one; the others came since the one before
                earliest = arrived if i == len(messages) - 1 else connection.arrived
                self._emit(earliest, arrived, connection.number, port, UP, message)
            mischief = self._mischief.get((port, direction), passing)
            for asked, made in mischief(message):
                delay = max(asked, self._stalled_until - now)
                if delay > 0.0:
                    item = (now + delay, next(self._order), connection, direction, made)
                    heapq.heappush(self._due, item)
                else:
                    at_once.append(made)
        if direction == UP:
            connection.arrived = arrived
        self._send(connection, direction, at_once)

    def _send_due(self) -> None:
        now = time.monotonic()
        while self._due and self._due[0][0] <= now:
            _, _, connection, direction, message = heapq.heappop(self._due)
            if connection in self._connections:
                self._send(connection, direction, [message])

    def _send(self, connection: Connection, direction: str, messages: list[bytes]) -> None:
        if not messages:
            return
        before = time.monotonic()
        self._push(connection, direction, b"".join(messages))
        if direction == DOWN:
            after = time.monotonic()
            for message in messages:
                self._emit(before, after, connection.number, connection.port.name, DOWN, message)

    def _push(self, connection: Connection, direction: str, message: bytes) -> None:
        end = connection.ends.get(DOWN if direction == UP else UP)
        if end is None:
            return
        waiting = connection.out[direction]
        waiting += message
        try:
            del waiting[: end.send(waiting)]
        except BlockingIOError:
            pass  # goes out with the next message
        except OSError:
            self._drop(connection, reset=False)

    def _cut_all(self, reset: bool) -> None:
        for connection in list(self._connections):
            self._drop(connection, reset)

    def _drop(self, connection: Connection, reset: bool) -> None:
        if connection not in self._connections:
            return
        self._connections.remove(connection)
        for direction, end in connection.ends.items():
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(end)
            self._close(end, reset and direction == UP)

    @staticmethod
    def _close(end: socket.socket, reset: bool) -> None:
        with contextlib.suppress(OSError):
            if reset:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            end.close()


def _comes_last(ready: tuple[selectors.SelectorKey, int]) -> bool:
    """Return whether a socket that is ready is the controller's."""
    data = ready[0].data
    return isinstance(data, tuple) and data[1] == DOWN
