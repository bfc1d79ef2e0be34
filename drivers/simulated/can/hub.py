"""A CAN bus between processes: every frame goes to every other connection.

TCP connections speak socketcand's protocol (python-can's ``socketcand`` interface is the client),
serial lines that of an slcan adapter; both hang on the same bus. Loopback only.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
from typing import Self

from gapbridge.drivers.addresses import is_loopback
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.frame import Frame
from gapbridge.drivers.simulated.can.port import Port, SerialPort, SocketcandPort

MOST_PORTS = 64


class Hub:
    """One simulated bus, served by a thread between ``start`` and ``close``."""

    def __init__(self, clock: Clock, host: str = "127.0.0.1", port: int = 0) -> None:
        self._clock = clock
        if not is_loopback(host):
            raise ValueError(f"host: found {host!r}, expected a loopback address (127.x.x.x)")
        self.host = host
        self.port = port  # TCP; 0 until start() if the system chooses it
        self.frames = 0  # sent over the bus
        self._selector = selectors.DefaultSelector()
        self._ports: dict[int, Port] = {}
        self._full: set[int] = set()  # descriptors of ports that wait until they can write
        self._listener: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._wake_in, self._wake_out = -1, -1
        self._terminals: list[int] = []
        self._stopping = False
        self._lock = threading.RLock()  # the thread's ports against frames from this process

    def start(self) -> Hub:
        """Listen, and serve in a thread. Raises OSError if the port is taken."""
        listener = socket.create_server((self.host, self.port), backlog=16)
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener
        self._wake_out, self._wake_in = os.pipe()
        self._selector.register(listener, selectors.EVENT_READ)
        self._selector.register(self._wake_out, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._serve, name="can-hub", daemon=True)
        self._thread.start()
        return self

    def add_terminal(self) -> str:
        """Return the path of a serial line of a new slcan adapter on this bus."""
        master, slave = os.openpty()
        path = os.ttyname(slave)
        self._terminals.append(slave)  # kept open, so that clients may reconnect
        self._add(SerialPort(master))
        self._wake()
        return path

    def send(self, frame: Frame, source: Port | None = None) -> None:
        """Send one frame from this process to every connection but ``source``.

        It is sent in the caller's thread, without a delay by another thread.
        """
        with self._lock:
            self._broadcast(frame, source)

    def attach(self, port: Port) -> None:
        """Attach a port of this process, which receives the frames of others."""
        with self._lock:
            self._ports[port.fd] = port

    def close(self) -> None:
        """Close every connection; may be repeated."""
        self._stopping = True
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._wake()
        thread.join(5.0)
        for port in list(self._ports.values()):
            self._drop(port)
        for fd in (*self._terminals, self._wake_in, self._wake_out):
            os.close(fd)
        if self._listener is not None:
            self._listener.close()
        self._selector.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            os.write(self._wake_in, b".")

    def _serve(self) -> None:
        while not self._stopping:
            for key, events in self._selector.select():
                if key.fileobj is self._listener:
                    self._accept()
                elif key.fd == self._wake_out:
                    os.read(self._wake_out, 64)
                elif (port := self._ports.get(key.fd)) is not None:
                    with self._lock:
                        self._serve_port(port, events)

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            link, _ = self._listener.accept()
        except OSError:
            return
        if len(self._ports) >= MOST_PORTS:
            link.close()
            return
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._add(SocketcandPort(link, self._clock))

    def _add(self, port: Port) -> None:
        with self._lock:
            self._ports[port.fd] = port
            self._selector.register(port.fd, self._wanted(port))

    def _serve_port(self, port: Port, events: int) -> None:
        try:
            frames = port.receive() if events & selectors.EVENT_READ else []
            port.flush()
        except OSError:
            self._drop(port)
            return
        self._watch(port)
        for frame in frames:
            self._broadcast(frame, port)

    def _broadcast(self, frame: Frame, source: Port | None) -> None:
        self.frames += 1
        stamp = self._clock.time()
        for port in list(self._ports.values()):
            if port is source:
                continue
            try:
                port.deliver(frame, stamp)
            except OSError:
                self._drop(port)
                continue
            self._watch(port)

    @staticmethod
    def _wanted(port: Port) -> int:
        return selectors.EVENT_READ | (selectors.EVENT_WRITE if port.waiting else 0)

    def _watch(self, port: Port) -> None:
        if port.waiting != (port.fd in self._full):
            self._full ^= {port.fd}
            self._selector.modify(port.fd, self._wanted(port))

    def _drop(self, port: Port) -> None:
        if self._ports.pop(port.fd, None) is None:
            return
        self._full.discard(port.fd)
        if port.fd >= 0:
            with contextlib.suppress(OSError, KeyError, ValueError):
                self._selector.unregister(port.fd)
        port.close()
