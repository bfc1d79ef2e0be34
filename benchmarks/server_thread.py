"""A simulated controller in a thread of this process, for tests and benchmarks."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from gapbridge.drivers import ur_rtde
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer, ServerLoop

OFFSET_SCRIPT = Path(ur_rtde.__path__[0]) / "gapbridge_offset.script"


class ServerThread:
    """A controller served by a thread of this process while the `with` block lasts."""

    def __init__(
        self,
        controller: ArmController,
        servers: Sequence[ProtocolServer],
        host: str,
        bench_port: int = 0,
    ) -> None:
        self.controller = controller
        self.loop = ServerLoop(controller, servers, host, bench_port, SYSTEM)
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open every port and start the thread. Raises LinkError."""
        self.loop.open()
        self._ended.clear()
        self._thread = threading.Thread(
            target=self.loop.run, args=(self._ended.is_set,), daemon=True, name="controller"
        )
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close every port; the state stays for another ``start``."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(5.0)
            self._thread = None
        self.loop.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
