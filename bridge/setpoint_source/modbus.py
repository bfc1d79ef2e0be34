"""Setpoints from a PLC over Modbus TCP; the register map is in modbus_server.py."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np

from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.setpoint_source.interpolator import InterpolatedSource
from gapbridge.bridge.setpoint_source.plc_memory import MOST_JOINTS, PlcMemory
from gapbridge.bridge.setpoint_source.source import SourceContext, SourceStatus
from gapbridge.core.errors import InputError, RunError

WRITTEN, LIMITED = 1, 2  # flags
CHECK_INTERVAL = 0.5  # s between looks at the server's process

SERVER = "gapbridge.bridge.setpoint_source.modbus_server"  # module of the server process


class ModbusSource(InterpolatedSource):
    """Serves a PLC in a separate process, and reports the loop's status to it.

    Raises InputError for an arm with more joints than the registers hold.
    """

    expected = "new sequence number"

    def __init__(self, context: SourceContext) -> None:
        super().__init__(context)
        if self.n > MOST_JOINTS:
            raise InputError(
                f"found {self.n} joints, expected {MOST_JOINTS}", ("setpoints", "source")
            )
        self._memory: PlcMemory | None = None
        self._server: subprocess.Popen[str] | None = None
        self._sequence: int | None = None
        self._cycle = 0
        self._next_check = 0.0  # s, monotonic
        self._ended_since: float | None = None  # s, monotonic: the server's process has ended
        self.port = 0

    def open(self) -> None:
        """Start the server. Raises RunError where the address is taken."""
        memory = self._memory = PlcMemory(self.n)
        path = os.pathsep.join(p for p in sys.path if p)
        # safe path: else ``-m`` imports first what lies in the working folder
        environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
        server = self._server = subprocess.Popen(
            [sys.executable, "-m", SERVER],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
            pass_fds=memory.fds,
        )  # fmt: skip
        assert server.stdin is not None
        assert server.stdout is not None
        address = {"host": self.settings.host, "port": self.settings.port, "n": self.n}
        server.stdin.write(json.dumps({**address, "memory": memory.fds}) + "\n")
        server.stdin.flush()
        reply = json.loads(server.stdout.readline() or '{"failure": "its server ended"}')
        if "failure" in reply:
            self.close()
            raise RunError(f"setpoints: {reply['failure']}")
        if not memory.is_sealed:
            self.close()
            raise RunError("setpoints: its server did not seal what it writes to")
        self.port = int(reply["port"])

    def close(self) -> None:
        """End the server."""
        server, self._server = self._server, None
        if server is not None:
            server.kill()
            server.wait()
            for stream in (server.stdin, server.stdout):
                if stream is not None:
                    stream.close()
        memory, self._memory = self._memory, None
        if memory is not None:
            memory.close()

    def _receive(self) -> bool:
        record = None if self._memory is None else self._memory.setpoint()
        if record is None or record[0] == self._sequence:
            return False
        self._sequence = record[0]
        self._interpolator.take(record[1])
        return True

    def emit(self, reported: SourceStatus) -> None:
        """Report state, corrected and nominal joints to the PLC.

        Raises RunError where its server has ended, though not while setpoints are written or an
        armed driver may await its first one: the source runs dry before.
        """
        if self._memory is None:
            return
        self._check_server(State(reported.state))
        self._cycle += 1
        flags = (WRITTEN if reported.written else 0) | (LIMITED if reported.clamped else 0)
        self._memory.put_status(
            (int(reported.state), self._sequence or 0, self._cycle, flags),
            np.concatenate([reported.corrected_q, reported.nominal_q, reported.offset_in_base]),
        )

    def _check_server(self, state: State) -> None:
        """Raise RunError once the server has ended; the loop's next process starts another."""
        now = self._clock.monotonic()
        if now < self._next_check or self._server is None:
            return
        self._next_check = now + CHECK_INTERVAL
        if self._server.poll() is None:
            return
        if self._ended_since is None:
            self._ended_since = now
        if not state.writes and now - self._ended_since > self.settings.timeout:
            code = self._server.returncode
            raise RunError(f"setpoints: the server for the PLC has ended (exit code {code})")
