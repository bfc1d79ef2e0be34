"""A recording of the daemon as a controller: its states again, with their timing.

The daemon computes again from the same numbers: with the same cell, bit-identical offsets; with
another cell, what that one would have computed. Nothing is written to a robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, LogError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.replay.settings import ReplaySettings

if TYPE_CHECKING:
    from gapbridge.core.model import Model

NEEDED = (
    "number", "timestamp", "state", "written", "attempted", "flags", "nominal_q", "own_q",
    "ramp_time", "rate", "loop", "target_q", "actual_q", "actual_qd", "actual_TCP_force",
    "robot_mode", "safety_mode", "runtime_state", "safety_status_bits", "speed_scaling",
)  # fmt: skip
LONGEST_PAUSE = 1.0  # s: longer gaps of a recording are not waited for


class EndOfRecordingError(LinkError):
    """The recording has come to its end."""


@dataclass(frozen=True, slots=True)
class Cycle:
    """A recorded cycle, except the controller's state."""

    number: int
    loop: int  # which process of the loop it was
    state: int  # of the supervisor, at its end
    written: bool
    attempted: int  # 0: not writing; 1: a setpoint was, or was refused; 2: computed, not sent
    flags: int  # of the loop's own
    own_q: Array  # (n,) rad, the robot's own target joints
    nominal_q: Array  # (n,) rad, for which the correction was computed
    ramp_time: float  # s


class ReplayDriver(Driver):
    """Returns the states of a recording, one after the other; ``cycle`` is the present one.

    The constructor reads the recording's first cycle: its rate is the driver's. Raises LogError if
    the recording has none, or is of another arm.
    """

    def __init__(self, settings: ReplaySettings, model: Model, clock: Clock) -> None:
        self.settings = settings
        first = next(self._rows(), None)
        if first is None:
            raise LogError(f"{settings.file}: found no cycles, expected a recording to replay")
        missing = [name for name in NEEDED if name not in first]
        if missing:
            raise LogError(f"{settings.file}: found no {missing[0]}, expected it for a replay")
        n = len(first["actual_q"])
        if n != model.arm.n:
            raise LogError(
                f"{settings.file}: found {n} joints, expected {model.arm.n} as the cell's arm has"
            )
        super().__init__(float(first["rate"]), model, clock=clock)
        self.gate.set_clock(lambda: self._last)  # a replay may be faster than the recording
        self.cycle: Cycle | None = None
        self._left: Iterator[Mapping[str, Array]] = iter(())
        self._begun = 0.0  # s, monotonic: when the recording's time 0 was
        self._last = -np.inf  # s, controller clock

    def connect(self) -> None:
        """Go to the beginning of the recording."""
        self._left = self._rows()
        self._last = -np.inf

    def _read_state(self) -> RobotState:
        """Wait for the recorded time, and return the next state.

        Raises EndOfRecordingError if there is none.
        """
        row = next(self._left, None)
        if row is None:
            raise EndOfRecordingError(f"{self.settings.file}: the recording has come to its end")
        self._wait(float(row["timestamp"]))
        self.cycle = Cycle(
            int(row["number"]), int(row["loop"]), int(row["state"]), bool(row["written"]),
            int(row["attempted"]), int(row["flags"]), row["own_q"], row["nominal_q"],
            float(row["ramp_time"]),
        )  # fmt: skip
        return _state(row, self._now())

    def _validate(self, state: RobotState) -> None:
        """Accept it: it was checked when it was recorded."""

    def nominal_q(self, state: RobotState) -> Array:
        """Return the robot's own target joints in the recording, (n,) rad."""
        assert self.cycle is not None
        return self.cycle.own_q

    def _send(self, setpoint: Setpoint) -> None:
        """Do nothing: there is no arm."""

    def close(self) -> None:
        """Close the recording."""
        self._left = iter(())

    def _rows(self) -> Iterator[Mapping[str, Array]]:
        from gapbridge.core.log.mcap_reading import read_batches  # only who replays loads MCAP

        for batch in read_batches(self.settings.file):
            for k in range(len(batch)):
                yield {name: values[k] for name, values in batch.columns.items()}

    def _wait(self, timestamp: float) -> None:
        now, speed = self._now(), self.settings.speed
        if not 0.0 < timestamp - self._last < LONGEST_PAUSE:
            self._begun = now - timestamp / speed
        self._last = timestamp
        self.clock.sleep(max(self._begun + timestamp / speed - now, 0.0))


def _state(row: Mapping[str, Array], received: float) -> RobotState:
    """Return the state of a recorded cycle; missing fields are NaN in the recording."""

    def known(name: str) -> Array | None:
        value = row.get(name)
        return None if value is None or np.isnan(value).all() else value

    payload = known("payload")
    return RobotState(
        timestamp=float(row["timestamp"]),
        received=received,
        actual_q=row["actual_q"],
        actual_qd=row["actual_qd"],
        target_q=row["target_q"],
        actual_TCP_force=row["actual_TCP_force"],
        ft_raw_wrench=known("ft_raw_wrench"),
        joint_temperatures=known("joint_temperatures"),
        actual_current_as_torque=known("actual_current_as_torque"),
        payload=None if payload is None else float(payload),
        payload_cog=known("payload_cog"),
        robot_mode=int(row["robot_mode"]),
        safety_mode=int(row["safety_mode"]),
        runtime_state=int(row["runtime_state"]),
        safety_status_bits=int(row["safety_status_bits"]),
        speed_scaling=float(row["speed_scaling"]),
        sensor_lost="" if known("actual_TCP_force") is not None else "as recorded",
    )
