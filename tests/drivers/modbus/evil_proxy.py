"""A proxy between a driver and its controller that ruins answers."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from typing import Self

Ruin = Callable[[bytes], bytes]


class EvilProxy:
    """Hands bytes on; ``ruin`` changes the controller's answers, ``wait`` (s) delays them."""

    def __init__(self, host: str, port: int) -> None:
        self._target = (host, port)
        self.ruin: Ruin = lambda answer: answer
        self.wait = 0.0
        self._listener = socket.create_server((host, 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError), client, socket.create_connection(self._target) as real:
            real.settimeout(2.0)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while request := client.recv(4096):
                real.sendall(request)
                answer = self.ruin(real.recv(4096))
                time.sleep(self.wait)
                if not answer:
                    return
                client.sendall(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread: the number is used again
        self._listener.close()
