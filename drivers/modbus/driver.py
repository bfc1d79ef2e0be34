"""The Modbus driver: profile, transport, decoder, freshness and writer put together."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.compensation import wanted_pose
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.modbus.decode import Decoder, Sample, check_identity
from gapbridge.drivers.modbus.freshness import Freshness
from gapbridge.drivers.modbus.map import compile_map
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.transport import Transport
from gapbridge.drivers.modbus.write import make_writer
from gapbridge.drivers.offset_inverse import Nominal
from gapbridge.drivers.robot_modes import modes_of, why_not_ready

SLOW_EVERY = 0.2  # s between two readings of the slow blocks
ANSWER_CYCLES, ANSWER_TIME = 4.0, 0.03  # cycles, s: an older answer is not fresh


class ModbusDriver(Driver):
    """One arm on Modbus. The profile gives the register map and the way to write setpoints."""

    def __init__(self, settings: ModbusSettings, model: Model, clock: Clock) -> None:
        self.profile = profile = read_profile(settings.profile_path, model.arm.n)
        reads_targets = profile.write.mode == "mailbox"
        super().__init__(settings.rate, model, not reads_targets, clock, profile.fastest)
        self.settings = settings
        self.map = compile_map(profile)
        device = profile.device_id if settings.device_id is None else settings.device_id
        self.transport = Transport(settings, settings.port or profile.port, device)
        self.transport.allow(self.map)
        self._model = model
        self._decoder = Decoder(profile, self.map)
        self._freshness = Freshness(profile)
        self._writer = make_writer(
            profile, self.transport, self._offset_rates, 0.5 * settings.connect_timeout, clock
        )
        self._nominal = None if self.moves_arm else Nominal(model)
        self._first_block, *self._other_blocks = self.map.fast
        self._slow: list[bytes] = []
        self._slow_at = 0.0
        self._due = 0.0  # s, monotonic: when the next reading is due
        self._fresh_at = 0.0  # s, monotonic: of the last new sample
        self._sample: Sample | None = None
        self._before: RobotState | None = None  # the last plausible one
        self._longest_answer = max(ANSWER_CYCLES / self.rate, ANSWER_TIME)  # s
        self._given = 0.0  # s, monotonic: when the last setpoint was passed to the writer
        self._connected = False
        self._answer: float | None = None  # s: round-trip time of the last reading
        self._quickest = math.inf  # s: the shortest of them since the link was opened

    # -- reading ----------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the link and check that it is the profile's controller. Writes nothing."""
        self.transport.open()
        try:
            identity = [self.transport.read(block) for block in self.map.identity]
            with self._naming_link():
                check_identity(self.profile, self.map, identity)
            self._slow_at, self._quickest = 0.0, math.inf
            blocks = self._read_blocks()
            with self._naming_link():
                self._freshness.restart()
                self._check_first_sample(self._decoder.decode(blocks))
        except InvalidStateError as error:
            self.transport.close()
            raise LinkError(str(error)) from None
        except LinkError:
            self.transport.close()
            raise
        self._connected = True
        self._due = self._fresh_at = self._now()

    @contextlib.contextmanager
    def _naming_link(self) -> Iterator[None]:
        """Add the link's name to errors of a check; errors of the transport have it."""
        try:
            yield
        except InvalidStateError as error:
            raise InvalidStateError(f"{self.transport.name}: {error}") from None

    def _check_first_sample(self, sample: Sample) -> None:
        """Check the sample read when connecting; the next one is compared with it.

        Raises InvalidStateError where the arm cannot be there: units, word order or signs are
        wrong.
        """
        self._before = None
        self.reset_check()
        try:
            self._validate(self._state(sample, self._now()))
        except InvalidStateError as error:
            raise InvalidStateError(f"{error}; is the profile right?") from None

    def _read_state(self) -> RobotState:
        """Return the next new sample; see Driver.read_state."""
        if not self._connected:
            raise LinkError(f"{self.transport.name}: found no connection, expected connect() first")
        now = self._now()
        self._due = max(self._due + 1.0 / self.rate, now)
        if self._due > now:
            self.clock.sleep(self._due - now)
        limit = max(self._fresh_at, now) + self.settings.state_timeout
        while True:
            sample = self._try_reading()
            received = self._now()
            if sample is not None:
                q = sample.vectors["position"]
                if self._freshness.is_new(sample.clock, q, sample.vectors.get("velocity")):
                    self._sample = sample
                    return self._state(sample, received)
            if received > limit:
                raise StaleStateError(
                    f"{self.transport.name}: found no new sample for "
                    f"{received - self._fresh_at:.3f} s"
                )
            self.clock.sleep(min(self.profile.period / 4.0, 0.01))

    def _try_reading(self) -> Sample | None:
        """Return a sample, or None if there was no answer, or a late one.

        Late are answers delayed by the link, or by this process being suspended.
        """
        if not self.transport.is_open:
            self.transport.open()  # raises LinkError if the controller is gone
        requested_at = self._now()
        try:
            sample = self._decoder.decode(self._read_blocks())
        except StaleStateError:
            return None
        self._answer = self._now() - requested_at
        self._quickest = min(self._quickest, self._answer)
        return None if self._answer > self._longest_answer else sample

    def _read_blocks(self) -> list[bytes]:
        """Return the registers of one cycle: one block, where the profile's map allows it."""
        now = self._now()
        if self.map.slow and now - self._slow_at > SLOW_EVERY:
            self._slow = [self.transport.read(block) for block in self.map.slow]
            self._slow_at = now
        first = self._first_block
        pending = self._writer.pending()
        if now - self._given > self._longest_answer:
            pending = None  # computed from a state that is too old now
        if pending is not None and first.table == "holding":
            registers = [self.transport.exchange(first, *pending)]
        else:
            if pending is not None:
                self.transport.write("holding", *pending)
            registers = [self.transport.read(first)]
        for block in self._other_blocks:
            registers.append(self.transport.read(block))
        return registers + self._slow

    def _validate(self, state: RobotState) -> None:
        """See Driver._validate."""
        super()._validate(state)
        self._before, self._fresh_at = state, state.received

    def _state(self, sample: Sample, received: float) -> RobotState:
        vectors, before = sample.vectors, self._before
        q = vectors["position"]
        timestamp = self._freshness.take(sample.clock, q, received)
        velocity = vectors.get("velocity")
        if velocity is None:
            velocity = 0.0 * q
            if before is not None and received > before.received:
                velocity = (q - before.actual_q) / (received - before.received)
        sent = self._writer.target()
        target = vectors.get("target", q if sent is None else sent)
        force = np.zeros(6)
        if "force" in vectors:
            force[:3] = vectors["force"]
        if "moment" in vectors:
            force[3:] = vectors["moment"]
        modes = modes_of(reason for reason, _ in sample.stop_reasons)
        return RobotState(
            timestamp, received, q, velocity, target, force,
            joint_temperatures=vectors.get("temperature"),
            actual_current_as_torque=vectors.get("joint_torque"),
            **modes._asdict(),
        )  # fmt: skip

    def nominal_q(self, state: RobotState) -> Array:
        """Return the robot's own target joints (n,), rad: with a mailbox, without the offset."""
        if self._nominal is None or self._sample is None:
            return state.target_q
        return self._nominal.without(state.target_q, self._sample.vectors["echo"])

    def round_trip(self) -> float | None:
        """Return how long the last reading took, s; see Driver.round_trip."""
        return self._answer

    def take_round_trip(self) -> float | None:
        """Return how old the last reading may be by its request, s; see Driver.take_round_trip.

        The controller's registers are up to a period older than its answer.
        """
        if self._answer is None or not self._freshness.has_clock:
            return None
        return self._answer + self.profile.period

    def transit_time(self) -> float:
        """Return how long the last reading took, s; see Driver.transit_time.

        With a clock of the controller the shortest reading: timestamps show what exceeds it.
        """
        return self._quickest if self._freshness.has_clock else self._answer or 0.0

    # -- writing ----------------------------------------------------------------------------------

    def _make_ready(self, state: RobotState) -> None:
        """Check robot and resolution, and prepare for writing; moves nothing."""
        name = self.transport.name
        if self.profile.write.mode != "read_only":
            if why_not_ready(state):
                reasons = self._sample.stop_reasons if self._sample else ()
                detail = "; ".join(text for _, text in reasons)
                raise WriteError(f"{name}: the robot is not ready: {detail}")
            self._check_resolution(state.actual_q)
        self._writer.arm(state, self._look)

    def _look(self) -> Sample:
        try:
            return self._decoder.decode(self._read_blocks())
        except LinkError as error:
            raise WriteError(str(error)) from None

    def _check_resolution(self, q: Array) -> None:
        """Raise WriteError if one count of a target moves the TCP more than the present offset."""
        write = self.profile.write
        if write.mode != "target_trigger":
            return
        predicted = self._model.predict(q[None]).position[0]
        offset = float(np.linalg.norm(predicted - wanted_pose(self._model, q[None]).position[0]))
        coarsest = self.settings.coarsest or offset
        if coarsest == 0.0:
            return  # a rigid model: there is no offset
        count, reach = abs(write.target.resolution), self._model.length
        if count * reach > coarsest:
            raise WriteError(
                f"{self.transport.name}: {self.profile.name}'s target registers are too coarse: "
                f"one count ({1e3 * count:.3g} mrad) times the reach ({reach:.2f} m) is "
                f"{1e3 * count * reach:.3g} mm, and the offset at hand is {1e3 * coarsest:.3g} mm "
                "(link.coarsest)"
            )

    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint; needs ``arm`` before.

        With a mailbox and function 23 it is sent together with the next reading.
        """
        if self._sample is None:
            raise WriteError(f"{self.transport.name}: found no state, expected read_state() first")
        try:
            self._given = self._now()
            self._writer.write(setpoint, self._sample, self._expiry)
        except WriteError:
            raise
        except LinkError as error:
            raise WriteError(str(error)) from None

    def _release(self) -> None:
        """Stop writing: no more heartbeats, or the controller's stop."""
        try:
            self._writer.release()
        except WriteError:
            raise
        except LinkError as error:
            raise WriteError(str(error)) from None

    def close(self) -> None:
        """Release if the link works, and disconnect."""
        try:
            if self._connected:
                self.release()
        except LinkError:
            pass
        finally:
            self._connected = False
            self.transport.close()
