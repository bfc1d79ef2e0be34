"""The CANopen driver: one arm of CiA 402 drives, moved by SYNC and PDOs."""

from __future__ import annotations

import contextlib
import logging

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import (
    ForeignCommandError,
    InputError,
    InvalidStateError,
    LinkError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.canopen.command import RpdoWriter
from gapbridge.drivers.canopen.configure import (
    check_identity,
    check_units,
    interpolation_period,
    set_up,
)
from gapbridge.drivers.canopen.listening import OPERATIONAL, Emergency, ForeignCommand
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.objects import FAULTS
from gapbridge.drivers.canopen.power import Power
from gapbridge.drivers.canopen.profile import WINDOW, read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.state import StateBuilder, not_following, positions, states
from gapbridge.drivers.canopen.sync_set import SyncSet
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_facts import Difference
from gapbridge.drivers.driver import Driver

log = logging.getLogger("drivers.canopen")

MAX_SKIPPED_SYNCS = 3  # SYNCs after a torn set
LONGEST_WAIT, LONGEST_WAIT_CYCLES = 0.04, 5.0  # s, cycles: from a state to its setpoint's SYNC
STARTING = 2.0  # s in which drives must be OPERATIONAL and answer a SYNC


class CanopenDriver(Driver):
    """One arm of CiA 402 drives, of which we are the only master.

    Each ``read_state`` sends one SYNC; setpoints count at the SYNC after them. Nothing is enabled
    before ``arm``.
    """

    def __init__(self, settings: CanopenSettings, model: Model, clock: Clock) -> None:
        self.profile = read_profile(settings.profile_path, model.arm.n)
        super().__init__(settings.rate, model, clock=clock)
        fastest = 1.0 / self.profile.file.sync_period
        if settings.rate > fastest * (1.0 + 1e-9):
            raise InputError(
                f"found {settings.rate:g}, expected at most {fastest:g} SYNCs per second "
                f"(sync_period of {self.profile.path.name})",
                ("link", "rate"),
            )
        interpolation_period(1.0 / settings.rate)  # raises InputError
        self.settings = settings
        self.master = Master(settings, self.profile, clock)
        self.writer = RpdoWriter(self.master, self.profile)
        self._period = 1.0 / self.rate
        window = self.profile.file.sync_window or WINDOW * self._period
        self.sync_cycle = SyncCycle(self.master, self.writer, self._period, window, clock)
        self.power = Power(self.master, self.profile, self.writer, self.sync_cycle.exchange)
        self._arm = model.arm
        self._builder = StateBuilder(self.profile, settings.clear_faults)
        self._fresh_at = 0.0  # s, monotonic: of the last whole sample
        self._connected_at = 0.0
        self._armed_at: float | None = None  # s, monotonic
        self._quiet_at = 0.0  # s, monotonic: when arming began to look for another master
        self._moved_at = 0.0  # s, monotonic: when the joints last changed, or were at their target
        self._reported: Emergency | None = None  # that was written to the log last

    # -- connecting -------------------------------------------------------------------------------

    def connect(self) -> None:
        """Listen, set the drives' PDOs up and start their communication. Enables nothing."""
        master = self.master
        master.open()
        try:
            self.clock.sleep(self.settings.listen)
            if self.foreign is not None:
                raise LinkError(self._two_masters(self.foreign))
            for node in self.profile.nodes:
                check_identity(master, self.profile, node)
                master.command(node, "PRE-OPERATIONAL")
                set_up(master, self.profile, node, self._period)
            self.power.look()
            check_units(master, self.profile, self._arm)
            assert master.heartbeats is not None
            master.heartbeats.started()
            master.collector.clear_stray()
            for node in self.profile.nodes:
                master.command(node, "OPERATIONAL")
            self._first_sample()
        except LinkError:
            master.close()
            raise
        self._connected_at = self._now()
        self._armed_at = None
        self.reset_check()
        self._builder.reset()

    def _first_sample(self) -> None:
        """Wait until all drives are OPERATIONAL and answer a SYNC. Raises LinkError."""
        heartbeats = self.master.heartbeats
        assert heartbeats is not None
        end = self._now() + min(STARTING, self.settings.connect_timeout)
        while (sample := self.sync_cycle.exchange()) is None or not heartbeats.all_operational:
            if self._now() > end:
                why = self.master.collector.why() + " after a SYNC"
                if sample is not None:
                    silent = [n for n in self.profile.nodes if heartbeats.nmt.get(n) != OPERATIONAL]
                    why = f"found no heartbeat in OPERATIONAL of nodes {silent}"
                raise LinkError(f"{self.master.where}: {why}")
        try:
            self._validate(self._builder.build(sample, None, False))
        except InvalidStateError as error:
            raise LinkError(f"{self.settings.where()}: {error}") from None
        self._fresh_at = sample.received

    # -- reading ----------------------------------------------------------------------------------

    def _read_state(self) -> RobotState:
        """Send one SYNC and return what all drives reported at it; see Driver.read_state.

        Raises InvalidStateError where a set is torn, LinkError where a drive has restarted.
        """
        while True:
            stray = self.master.collector.stray
            sample = self.sync_cycle.exchange()
            self._check_heartbeats()
            if sample is not None and not stray:
                self._fresh_at = sample.received
                return self._state(sample)
            why = self.master.collector.why() if sample is None else f"{stray} came without a SYNC"
            now = self._now()
            if now - self._fresh_at > self.settings.state_timeout:
                raise StaleStateError(
                    f"{self.master.where}: no whole sample for {now - self._fresh_at:.3f} s: {why}"
                )
            if stray or not self.master.collector.empty:
                raise InvalidStateError(f"{self.master.where}: torn sample: {why}")

    def _check_heartbeats(self) -> None:
        """Raise where a drive's heartbeat has ended, or where it has restarted."""
        heartbeats = self.master.heartbeats
        assert heartbeats is not None
        if heartbeats.log and heartbeats.log[-1] is not self._reported:
            self._reported = heartbeats.log[-1]
            log.warning("%s: %s", self.master.where, self._reported)
        node = heartbeats.not_operational()
        if node is not None:
            why = (
                "has restarted"
                if node in heartbeats.restarted
                else f"NMT state {heartbeats.nmt[node]}"
            )
            raise LinkError(f"{self.master.where}: node {node}: {why}, expected OPERATIONAL")
        node = heartbeats.lost()
        if node is not None:
            raise StaleStateError(
                f"{self.master.where}: node {node}: no heartbeat for "
                f"{self.profile.heartbeat.lost_after:g} s{self.power.emergency(node)}"
            )

    def _validate(self, state: RobotState) -> None:
        """See Driver._validate."""
        super()._validate(state)
        self._builder.remember(state)

    def _state(self, sample: SyncSet) -> RobotState:
        armed = self._armed_at is not None
        before = self._builder.last_q
        state = self._builder.build(sample, self.writer.target if armed else None, armed)
        self._check_frozen(state, before)
        return state

    def _check_frozen(self, state: RobotState, before: Array | None) -> None:
        """Raise StaleStateError for joints that do not change though commanded elsewhere."""
        now, q = state.received, state.actual_q
        away = float(np.abs(state.target_q - q).max())
        moved = before is None or (q != before).any()
        if self._armed_at is None or moved or away < self.settings.frozen_distance:
            self._moved_at = now
        elif now - self._moved_at > self.settings.frozen_after:
            raise StaleStateError(
                f"{self.profile.name}: joints have not changed for {now - self._moved_at:.2f} s, "
                f"commanded {away:.3f} rad away"
            )

    def differences(self, state: RobotState) -> list[Difference]:
        """See Driver.differences; what no drive's own settings show is one, too."""
        return [*super().differences(state), *self.power.doubts()]

    # -- writing ----------------------------------------------------------------------------------

    @property
    def foreign(self) -> ForeignCommand | None:
        """Return the last frame of another master; None: there was none."""
        return self.master.listener.foreign if self.master.listener is not None else None

    def _two_masters(self, foreign: ForeignCommand) -> str:
        return (
            f"{self.master.where}: another master sent {foreign.what} "
            f"{self._now() - foreign.seen:.2f} s ago: found two masters, expected one"
        )

    def _make_ready(self, state: RobotState) -> None:
        """Enable the drives at the present joints. Raises WriteError, and then none is enabled."""
        if self._armed_at is not None:
            return
        try:
            sample = self._quiet_sample()
            for joint, reported in enumerate(states(sample)):
                if reported in FAULTS and not self.settings.clear_faults:
                    node = self.profile.nodes[joint]
                    raise WriteError(
                        f"{self.master.where}: node {node}: found {reported}"
                        f"{self.power.emergency(node)}, expected none; link.clear_faults resets it"
                    )
            self._enable(sample, state.actual_q)
        except WriteError:
            raise
        except LinkError as error:
            raise WriteError(str(error)) from None

    def _quiet_sample(self) -> SyncSet:
        """Return a sample after ``foreign_quiet`` s without another master. Raises LinkError."""
        begun = self._quiet_at = self._now()
        quiet = self.settings.foreign_quiet
        while True:
            foreign, now = self.foreign, self._now()
            if foreign is not None and (foreign.seen > begun or now - foreign.seen < quiet):
                raise ForeignCommandError(self._two_masters(foreign))
            sample = self.sync_cycle.exchange()
            self._check_heartbeats()
            if sample is not None and now - self._connected_at >= quiet:
                return sample
            if sample is None and now - self._fresh_at > quiet + self.settings.state_timeout:
                raise StaleStateError(f"{self.master.where}: {self.master.collector.why()}")

    def _enable(self, sample: SyncSet, start: Array) -> None:
        """Enable; ``start`` (n,) rad is of a checked sample, and those read meanwhile are not."""
        settings = self.settings

        def near(latest: SyncSet) -> Array:
            present = positions(self.profile, latest)
            displacement = float(np.abs(present - start).max())
            if not displacement <= settings.arming_distance:
                raise WriteError(
                    f"{self.profile.name}: the arm moved {displacement:.3f} rad when enabled"
                )
            return present

        near(sample)
        self.power.check_modes(sample)
        self.writer.load()  # first: without it nothing can be sent, not even what disables
        try:
            self.power.prepare()
            hold = self.power.enable(sample, near, settings.arming_time, settings.clear_faults)
            self._check_foreign()
            self.writer.send([self.power.following] * self.n, hold)
        except LinkError:
            with contextlib.suppress(LinkError):
                self.power.disable()
                self.power.restore()
            raise
        self._armed_at = self._moved_at = self._fresh_at = self._now()
        self._builder.reset()

    def _check_foreign(self) -> None:
        """Raise ForeignCommandError for another master since arming began."""
        foreign = self.foreign
        if foreign is not None and foreign.seen > self._quiet_at:
            raise ForeignCommandError(self._two_masters(foreign))

    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint, which counts at the next SYNC; needs ``arm`` before."""
        sample = self.sync_cycle.sample
        if self._armed_at is None or sample is None:
            raise WriteError(f"{self.master.where}: found a setpoint, expected arm() first")
        self._check_foreign()
        joint = not_following(self.profile, sample)
        if joint is not None:
            node = self.profile.nodes[joint]
            raise WriteError(
                f"{self.master.where}: node {node}: found {states(sample)[joint]}, expected "
                f"a drive that follows setpoints{self.power.emergency(node)}"
            )
        expires = sample.received + max(LONGEST_WAIT, LONGEST_WAIT_CYCLES * self._period)
        self.writer.send([self.power.following] * self.n, setpoint.q, expires)

    def _take_lapsed(self) -> bool:
        return self.writer.take_lapsed()

    def _release(self) -> None:
        """Quick stop, then switch the drives off and give them back their mode."""
        if self._armed_at is None:
            return
        self._armed_at = None
        try:
            self.power.disable()
            self.power.restore()
        except WriteError:
            raise
        except LinkError as error:
            raise WriteError(str(error)) from None
        finally:
            self._builder.reset()
            self._fresh_at = self._now()

    def close(self) -> None:
        """Release if the link works, end the drives' PDOs and close the bus."""
        with contextlib.suppress(LinkError):
            self.release()
        with contextlib.suppress(LinkError):
            for node in self.profile.nodes:
                self.master.command(node, "PRE-OPERATIONAL")
        self.master.close()


class SyncCycle:
    """Sends SYNCs at absolute deadlines and collects the TPDOs that answer them."""

    def __init__(
        self, master: Master, writer: RpdoWriter, period: float, window: float, clock: Clock
    ) -> None:
        self._master, self._writer, self._clock = master, writer, clock
        self._period, self._window = period, window  # s
        self._due = 0.0  # s, monotonic: of the next SYNC
        self._torn = False  # the last set was not whole
        self.sample: SyncSet | None = None  # the last that was whole

    def exchange(self) -> SyncSet | None:
        """Send one SYNC when it is due and return its TPDOs, None where they are torn.

        Raises LinkError if the bus is lost, or if the drives hold a part of a setpoint.
        """
        if self._torn:
            self._skip_syncs()
        self._wait_for_slot()
        self._writer.complete_set(self._clock.monotonic())
        collector = self._master.collector
        collector.clear_stray()
        synced = self._master.sync()
        self._writer.synced()
        sample = collector.wait(synced + self._window)
        self._torn = sample is None
        if sample is not None:
            self.sample = sample
        return sample

    def _wait_for_slot(self) -> None:
        now = self._clock.monotonic()
        self._due += self._period
        if self._due < now - 0.5 * self._period:
            self._due = now  # too late for the slot: no burst
        if self._due > now:
            self._clock.sleep(self._due - now)

    def _skip_syncs(self) -> None:
        """Leave SYNCs out after a torn set: one, and up to three while TPDOs are missing.

        Otherwise late TPDOs would be attributed to the next SYNC.
        """
        for _ in range(MAX_SKIPPED_SYNCS):
            self._wait_for_slot()
            self._master.beat()
            if not self._master.collector.awaits_late:
                return
