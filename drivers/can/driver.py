"""The CAN driver: an arm by its map of frames, reading and writing halves put together."""

from __future__ import annotations

import contextlib

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import (
    ForeignCommandError,
    InvalidStateError,
    LinkError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.can.assembler import Sample
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.reader import FrameReader
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can.state import StateBuilder
from gapbridge.drivers.can.writer import FrameWriter, Hold
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.profile_file import ProfileError

FIRST_SAMPLE = 2.0  # s in which an arm on the bus must have reported everything once
SLICE = 0.02  # s, of one wait for a frame
ANSWER = 0.02  # s after which an answer that is not there does not come
FRESH, OLDEST_HOLD = 0.1, 0.2  # s: of reading before enabling; age of joints to be held at most


class CanDriver(Driver):
    """One arm whose joints are reported and commanded in CAN frames, as a profile maps them.

    Another node that sends our control identifiers is another commander: then arming is refused,
    and an armed driver stops writing.
    """

    def __init__(self, settings: CanSettings, model: Model, clock: Clock) -> None:
        profile = read_profile(settings.profile_path, settings.installation)
        super().__init__(min(settings.rate, profile.rate), model, clock=clock)
        if model.arm.n != profile.n:
            raise ProfileError(
                f"found {profile.n} joints in {profile.name}, expected {model.arm.n}: the cell's "
                "arm has those",
                ("link", "profile"),
            )
        self.settings, self.profile = settings, profile
        self.reader = FrameReader(settings, profile, clock)
        self.writer = FrameWriter(settings, profile, clock)
        self._builder = StateBuilder(profile.n)
        self._armed_at: float | None = None  # s, monotonic
        self._quiet_at = 0.0  # s, monotonic: when arming found no other commander
        self._returned_at = -1.0  # s, received of the sample last returned
        self._slot = 0.0  # s, monotonic: when the next request is due
        self._changed = 0.0  # s, monotonic: when the joints last changed
        self._q: Array | None = None
        self._q_at = 0.0  # s, monotonic: when they were received
        self._angles: list[float] = []  # the same, as they were reported in the last sample
        self._broken = 0  # dropped samples that were reported
        self._pending: Sample | None = None  # received before a dropped one was reported
        self._listening = 0.0  # s, monotonic: listening for other commanders since

    # -- reading ----------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open the bus and wait until the arm has reported everything once. Sends no command."""
        self.reader.open()
        self.writer.use(self.reader.bus)
        self._listening = self._now()
        end = self._now() + min(FIRST_SAMPLE, self.settings.connect_timeout)
        received = False
        while not received or self.reader.silent_status():
            if self._now() > end:
                raise self._nothing_received(received)
            self._ask()
            received = self.reader.listen(max(1.0 / self.rate, SLICE)) is not None or received
        self._changed = self._now()
        self._reset_reading()

    def _reset_reading(self) -> None:
        """Discard torn frames and ended stops from before, when no states were read."""
        self._broken, self._pending = self.reader.assembler.broken, None
        self._builder.reset()
        self.reader.clear_ended_stops()

    def _nothing_received(self, complete: bool) -> LinkError:
        """Close the link and return an error that names the messages not received."""
        received_at = self.reader.assembler.received_at
        missing = [i.name for key, i in self.profile.incoming.items() if key not in received_at]
        dropped = dict(self.reader.assembler.dropped)
        message = f"never heard {', '.join(missing)}" if missing else "no complete sample"
        if not missing and complete:
            message = f"{self.reader.silent_status()} has fallen silent"
        self.close()
        detail = f"; dropped: {dropped}" if dropped else ""
        return LinkError(f"{self.settings.where()}: {self.profile.name}: {message}{detail}")

    def _ask(self) -> None:
        with contextlib.suppress(WriteError):  # silence follows, and is reported
            self.writer.request()

    def _read_state(self) -> RobotState:
        """Return the newest complete sample not returned before; see Driver.read_state."""
        sample = self._requested() if self.profile.request else self._received()
        self._returned_at = sample.received
        if silent := self.reader.silent_status():
            raise StaleStateError(
                f"{self.settings.where()}: no {silent} for {self.profile.status_timeout:g} s"
            )
        self._check_frozen(sample)
        armed = self._armed_at is not None
        # a stop counts too if it began and ended between two samples
        stop_reason = self.reader.stop_reason(armed)[0] or self.reader.ended_stop_reason(armed)
        ready = not armed or not self.profile.enabled_values or self.reader.enabled
        return self._builder.build(sample, self._target(), stop_reason, ready)

    def _validate(self, state: RobotState) -> None:
        """See Driver._validate."""
        super()._validate(state)
        self._builder.remember()
        self.reader.clear_ended_stops()

    def _received(self) -> Sample:
        """Return the next sample of an arm that sends unasked, at ``rate`` or slower."""
        end = self._now() + self.settings.state_timeout
        earliest = self._returned_at + 1.0 / self.rate - 0.5 / self.profile.rate
        sample, self._pending = self.reader.newest() or self._pending, None
        self._check_torn(sample)
        while sample is None or sample.received < earliest:
            remaining = end - self._now()
            if remaining <= 0.0:
                raise self._stale()
            sample = self.reader.poll(min(remaining, SLICE)) or sample
            self._check_torn(sample)
        return sample

    def _check_torn(self, sample: Sample | None) -> None:
        """Raise InvalidStateError once for frames that form no sample; keeps a good sample."""
        broken, self._broken = self._broken, self.reader.assembler.broken
        if self._broken > broken:
            self._pending = sample
            detail = ", ".join(f"{n} {why}" for why, n in self.reader.assembler.dropped.items())
            raise InvalidStateError(
                f"{self.profile.name}: frames that make no sample were dropped (so far {detail})"
            )

    def _requested(self) -> Sample:
        """Request a sample, once per cycle, and return it."""
        now = self._now()
        self._slot = max(self._slot + 1.0 / self.rate, now - 1.0 / self.rate)
        if self._slot > now:
            self.reader.listen(self._slot - now)
        self.reader.newest()
        self.reader.assembler.reset()
        requested_at = self._now()
        self._ask()
        end = requested_at + self.settings.state_timeout
        patience = max(ANSWER, 2.0 / self.rate)
        whole = requested_at + patience
        while (remaining := end - self._now()) > 0.0:
            sample = self.reader.poll(min(remaining, SLICE))
            if sample is not None and sample.began >= requested_at:
                return sample
            if (now := self._now()) <= whole:
                continue
            if missing := self.reader.assembler.missing:
                raise InvalidStateError(f"{self.profile.name}: no answer of {', '.join(missing)}")
            whole = now + patience
            self._ask()  # the request was lost
        raise self._stale()

    def _stale(self) -> StaleStateError:
        silent = (
            f"for {self._now() - self._returned_at:.3f} s" if self._returned_at > 0.0 else "yet"
        )
        errors = self.reader.error_frames
        detail = f" ({errors} error frames so far)" if errors else ""
        return StaleStateError(
            f"{self.settings.where()}: {self.profile.name}: no complete sample {silent}{detail}"
        )

    def _check_frozen(self, sample: Sample) -> None:
        """Raise StaleStateError for joints that do not change though commanded elsewhere."""
        now, target = sample.received, self.writer.target
        # lists: faster than arrays of six
        q, self._q_at = sample.position.tolist(), now
        if q != self._angles:
            self._q, self._angles, self._changed = sample.position, q, now
        if self._armed_at is None or target is None:
            return
        away = max(abs(goal - angle) for goal, angle in zip(target.tolist(), q, strict=True))
        if away < self.settings.frozen_distance:
            self._changed = now
        elif now - self._changed > self.settings.frozen_after:
            raise StaleStateError(
                f"{self.profile.name}: joints have not changed for {now - self._changed:.2f} s, "
                f"commanded {away:.3f} rad away"
            )

    def _target(self) -> Array | None:
        """Return the joints (n,) rad commanded last, by us or by another commander, or None."""
        if self._armed_at is not None:
            return self.writer.target
        return self.reader.foreign_target(self.settings.foreign_quiet)

    # -- writing ----------------------------------------------------------------------------------

    def _make_ready(self, state: RobotState) -> None:
        """Enable the motors at the present joints.

        Raises WriteError; none is enabled then, unless another commander has the arm.
        """
        if not self.profile.writes:
            raise WriteError(f"{self.profile.name}: this profile is read only")
        quiet = self.settings.foreign_quiet
        self._listen(max(self._listening + quiet - self._now(), FRESH))
        foreign = self.reader.foreign
        if foreign is not None and self._now() - foreign.seen < quiet:
            raise self._commanded_by_another()
        self._quiet_at = self._now()
        self._pending = None
        reason, message = self.reader.stop_reason(writing=False)
        if reason:
            raise WriteError(f"{self.profile.name}: {reason}: {message}")
        start = state.actual_q  # a checked sample's; those read while enabling are not checked
        self.writer.reset()
        try:
            self.writer.run(
                self.profile.enable, lambda: self._near(start), self._listen, self._reached
            )
            self._check_foreign()
            hold = self._near(start)
            if self.writer.target is None:
                self.writer.write(hold)
        except ForeignCommandError:
            self.writer.reset()  # the arm is another's: a hold would be a goal against theirs
            raise
        except LinkError:
            target = self.writer.target
            hold = start if target is None else target
            with contextlib.suppress(LinkError):
                self._run_release(lambda: self._held(start, hold))
            raise
        self._armed_at = self._changed = self._now()
        self._reset_reading()

    def _present(self) -> Array:
        if self._q is None:
            raise WriteError(f"{self.profile.name}: found no state, expected read_state() first")
        oldest = max(OLDEST_HOLD, self.settings.state_timeout)
        if (age := self._now() - self._q_at) > oldest:
            raise WriteError(
                f"{self.profile.name}: found joints {age:.2f} s old, expected at most {oldest:g} "
                "s: where the arm stands is not known"
            )
        return self._q

    def _near(self, start: Array) -> Array:
        """Return the present joints (n,), rad, to be held. Raises WriteError where they moved."""
        present = self._present()
        displacement = float(np.abs(present - start).max())
        if not displacement <= self.settings.arming_distance:
            raise WriteError(
                f"{self.profile.name}: the arm moved {displacement:.3f} rad when enabled"
            )
        return present

    def _held(self, start: Array, hold: Array) -> Array | None:
        """Return the joints (n,) that a refused arming holds; None: the arm is not there any more.

        A hold would pull it back, without limits.
        """
        with contextlib.suppress(WriteError):
            self._near(start)
            return hold
        return None

    def _listen(self, seconds: float) -> None:
        """Read for ``seconds``, sending requests where needed; updates the present joints."""
        end = self._now() + seconds
        while (remaining := end - self._now()) > 0.0 or seconds == 0.0:
            self._ask()
            sample = self.reader.listen(min(max(remaining, 0.001), 1.0 / self.rate))
            if sample is not None and np.isfinite(sample.position).all():
                self._q, self._angles = sample.position, sample.position.tolist()
                self._q_at = sample.received
            if seconds == 0.0:
                return

    def _reached(self, goal: str) -> bool:
        if goal == "disabled":
            return self.reader.disabled
        enabled = not self.profile.enabled_values or self.reader.enabled
        return enabled and (goal == "enabled" or not self.reader.stop_reason(writing=True)[0])

    def _check_foreign(self) -> None:
        """Raise ForeignCommandError for another commander since arming, while enabling too."""
        foreign = self.reader.foreign
        if foreign is not None and foreign.seen > self._quiet_at:
            raise self._commanded_by_another()

    def _commanded_by_another(self) -> ForeignCommandError:
        foreign = self.reader.foreign
        assert foreign is not None
        return ForeignCommandError(
            f"{self.settings.where()}: another commander sent {foreign.key[0]:#x} "
            f"{self._now() - foreign.seen:.2f} s ago: found two masters, expected one"
        )

    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint whole; needs ``arm`` before. Raises WriteError."""
        if self._armed_at is None:
            raise WriteError(f"{self.profile.name}: found a setpoint, expected arm() first")
        self._check_foreign()
        self.writer.write(setpoint.q)

    def _release(self) -> None:
        """Hold the last setpoint and run the release sequence."""
        if self._armed_at is None:
            return
        self._armed_at = None
        target = self.writer.target
        try:
            self._run_release(self._present if target is None else lambda: target)
        finally:
            self.writer.reset()
            self._reset_reading()

    def _abandon(self) -> None:
        """Send nothing: a hold would be a setpoint for an arm that has stopped."""
        self._armed_at = None
        self.writer.reset()
        self._reset_reading()

    def _run_release(self, hold: Hold) -> None:
        self.writer.run(self.profile.release, hold, self._listen, self._reached)
        self.writer.reset()

    def close(self) -> None:
        """Release if the link works, and close the bus; see Driver.close."""
        with contextlib.suppress(LinkError, InvalidStateError):
            self.release()
        self._armed_at = None
        self.writer.use(None)
        self.reader.close()
