"""Reading: RTDE samples of the ur_rtde library -> RobotState. Independent of writing.

The library keeps the last sample after the link is lost, and its ``isConnected`` returns True for
seconds after that. So a sample is fresh only if ``getTimestamp``, the controller's clock, has
changed. Getters lock one by one, so that a packet may arrive between two of them: the clock is read
again after the last getter, and a torn sample is read again.
"""

from __future__ import annotations

import re
from itertools import chain
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError, first_line
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.ur_rtde.registers import APPLIED, ECHO, PROGRAM
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

N = 6
POLL = 200e-6  # s: best of the polls measured (age 0.33 ms, a sixth of a core)
ATTEMPTS = 4

# field of RobotState: (getter, size, whether a controller may lack it)
_VECTORS: dict[str, tuple[str, int, bool]] = {
    "actual_q": ("getActualQ", N, False),
    "actual_qd": ("getActualQd", N, False),
    "target_q": ("getTargetQ", N, False),
    "actual_TCP_force": ("getActualTCPForce", 6, False),
    "ft_raw_wrench": ("getFtRawWrench", 6, True),
    "joint_temperatures": ("getJointTemperatures", N, True),
    "actual_current": ("getActualCurrent", N, True),
    "payload_cog": ("getPayloadCog", 3, True),
}
POSE = "actual_TCP_pose"  # read when it is asked for, not in every cycle
_NAMES = (
    "timestamp", *_VECTORS, POSE, "payload", "robot_mode", "safety_mode", "runtime_state",
    "safety_status_bits", "speed_scaling",
    f"output_int_register_{ECHO}", f"output_int_register_{PROGRAM}",
    *(f"output_double_register_{i}" for i in APPLIED),
)  # fmt: skip


class StateReader:
    """The reading half of a link to one controller."""

    def __init__(self, settings: UrRtdeSettings, clock: Clock) -> None:
        self._now, self._sleep = clock.monotonic, clock.sleep
        self._settings = settings
        self._receive: Any = None
        self._fields: list[tuple[str, slice]] = []  # in the numbers of a sample
        self._sizes: list[int] = []  # numbers of each field
        self._has_pose = False
        self._getters: list[Any] = []
        self._payload = True
        self._last = -1.0  # s, controller clock
        self._changed = 0.0  # s, monotonic: when that clock last moved
        self._registers = settings.mode == "offset"
        self.echo = 0
        self.program = 0
        self.applied = np.zeros(6)  # m, rad: offset in the target joints of the last sample
        self.torn = 0  # samples that were read again

    def open(self) -> None:
        """Connect and take the first sample. Raises LinkError."""
        settings = self._settings
        try:
            from rtde_receive import RTDEReceiveInterface
        except ImportError as error:
            raise LinkError(f"the ur_rtde library cannot be imported: {error}") from None
        names = list(_NAMES)
        while True:
            try:
                self._receive = RTDEReceiveInterface(settings.host, settings.rate, names)
                break
            except Exception as error:  # the library raises RuntimeError and boost's own
                reported = set(re.findall(r"\w+", str(error)))
                optional = [
                    m for m in names if m in reported and (m == "payload" or _is_optional(m))
                ]
                if "Could not connect" in str(error):
                    raise LinkError(
                        f"could not connect to {settings.host}, port 30004: is this the "
                        "controller's address, and does it run?"
                    ) from None
                if not optional:
                    raise LinkError(f"{settings.host}: {first_line(error)}") from None
                names = [name for name in names if name not in optional]
        self._lay_out(names)
        if not self._receive.isConnected() or not self._receive.getTimestamp():
            raise LinkError(f"{settings.host}: the controller refused the RTDE session")
        self._last, self._changed = -1.0, self._now()

    def _lay_out(self, names: list[str]) -> None:
        self._fields, self._sizes, self._getters, start = [], [], [], 0
        for name, (getter, size, _) in _VECTORS.items():
            if name in names:
                self._fields.append((name, slice(start, start + size)))
                self._sizes.append(size)
                self._getters.append(getattr(self._receive, getter))
                start += size
        self._payload, self._has_pose = "payload" in names, POSE in names

    def close(self) -> None:
        """Leave the link; may be repeated."""
        receive, self._receive = self._receive, None
        if receive is not None:
            receive.disconnect()

    @property
    def age(self) -> float:
        """Return for how long the controller's clock has not changed, s.

        0 if a sample waits that was not read yet: this process may have been busy.
        """
        if self._receive is not None and self._receive.getTimestamp() != self._last:
            return 0.0
        return self._now() - self._changed

    def read(self) -> RobotState:
        """Wait for a sample with a new timestamp. Raises StaleStateError, InvalidStateError.

        Waits at least one cycle, so that repeated calls without an answer do not occupy a core.
        """
        receive = self._receive
        if receive is None:
            raise LinkError(f"{self._settings.host}: found no connection, expected connect() first")
        cycle = self._now() + 1.0 / self._settings.rate
        until = max(self._changed + self._settings.state_timeout, cycle)
        timestamp = receive.getTimestamp()
        while timestamp == self._last:
            if self._now() > until:
                raise StaleStateError(
                    f"{self._settings.host}: the controller's clock has stopped at "
                    f"{timestamp:.3f} s for {self.age:.3f} s"
                )
            self._sleep(POLL)
            timestamp = receive.getTimestamp()
        self._last, self._changed = timestamp, self._now()
        return self._sample(timestamp)

    def _sample(self, timestamp: float) -> RobotState:
        """Return all fields of one cycle; reads again if a packet arrived in between."""
        receive = self._receive
        for _ in range(ATTEMPTS):
            received = self._changed
            rows = [getter() for getter in self._getters]
            modes = (
                receive.getRobotMode(), receive.getSafetyMode(), int(receive.getRuntimeState()),
                receive.getSafetyStatusBits(), receive.getSpeedScaling(),
            )  # fmt: skip
            payload = receive.getPayload() if self._payload else None
            if self._registers:
                self._read_registers()
            after = receive.getTimestamp()
            if after == timestamp:
                return self._state(timestamp, received, rows, modes, payload)
            self.torn += 1
            timestamp = self._last = after
            self._changed = self._now()
        raise InvalidStateError(
            f"{self._settings.host}: found a new sample in each of {ATTEMPTS} readings, expected "
            "one that does not change while it is read: this process is too slow for its rate"
        )

    def _read_registers(self) -> None:
        receive = self._receive
        self.echo = receive.getOutputIntRegister(ECHO)
        self.program = receive.getOutputIntRegister(PROGRAM)
        for i, register in enumerate(APPLIED):
            self.applied[i] = receive.getOutputDoubleRegister(register)

    def _state(
        self,
        timestamp: float,
        received: float,
        rows: list[list[float]],
        modes: tuple[int, int, int, int, float],
        payload: float | None,
    ) -> RobotState:
        """Return the sample. Raises InvalidStateError where a vector has another length."""
        if [*map(len, rows)] != self._sizes:
            for (name, _), size, row in zip(self._fields, self._sizes, rows, strict=True):
                if len(row) != size:
                    raise InvalidStateError(
                        f"{self._settings.host}: {name}: found {len(row)} numbers, expected {size}"
                    )
        values = np.array([*chain.from_iterable(rows)])
        fields: dict[str, Any] = {name: values[where] for name, where in self._fields}
        current, constants = fields.pop("actual_current", None), self._settings.torque_constants
        if current is not None and constants is not None:
            fields["actual_current_as_torque"] = current * constants
        return RobotState(
            timestamp, received, payload=payload, robot_mode=modes[0], safety_mode=modes[1],
            runtime_state=modes[2], safety_status_bits=modes[3], speed_scaling=modes[4],
            **fields,
        )  # fmt: skip

    def joints_and_tcp(self) -> tuple[Array, Array] | None:
        """Return joints (6,) and the controller's own TCP pose (6,) of one sample, or None.

        The pose is in base, m and rotation vector. None if the controller does not report it, or if
        each time a new sample arrived between the two.
        """
        receive = self._receive
        for _ in range(ATTEMPTS if self._has_pose else 0):
            before = receive.getTimestamp()
            q_and_tcp = receive.getActualQ(), receive.getActualTCPPose()
            if receive.getTimestamp() == before:
                return np.array(q_and_tcp[0]), np.array(q_and_tcp[1])
        return None


def _is_optional(name: str) -> bool:
    return name == POSE or (name in _VECTORS and _VECTORS[name][2])
