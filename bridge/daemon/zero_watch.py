"""What a run knows of its joints' zeros: slips, failed verifications, and what earlier runs saw."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.cell.runtime_folder import cell_key, state_folder
from gapbridge.bridge.daemon.kept_rests import KeptRests
from gapbridge.bridge.daemon.slip_watch import SlipWatch
from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.daemon.verification_watch import VerificationWatch
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError
from gapbridge.drivers.clock import Clock


class ZeroWatch:
    """The daemon's watches over the joints' zeros; for its own thread.

    ``slices``: where each field is in a cycle's row. ``status``: of the daemon, only read here.
    ``emit`` adds an event, which comes before the command to the loop that follows from it.
    """

    def __init__(
        self,
        configuration: Configuration,
        slices: Mapping[str, slice],
        status: DaemonStatus,
        emit: Callable[[Event], object],
        commands: CommandMemory,
        clock: Clock,
    ) -> None:
        self._configuration, self._slices, self._status = configuration, slices, status
        self._emit, self._commands = emit, commands
        settings = configuration.settings
        self.slips = self._slip_watch()
        self.kept = KeptRests(clock)
        self.verification = VerificationWatch(None if settings.uncorrected else settings.cell)

    def _slip_watch(self) -> SlipWatch:
        smallest = self._configuration.settings.limits.zero_slip
        return SlipWatch(self._configuration.model, self._slices, smallest)

    def open(self) -> None:
        """Continue with what the run before has learned of the joints' zeros."""
        settings = self._configuration.settings
        if settings.uncorrected or settings.link.driver == "replay" or not self.slips.watches:
            return
        try:
            path = state_folder() / f"{cell_key(settings.cell)}.rests.json"
            detail = self.kept.open(path, self.slips, self._configuration)
        except InputError as error:
            detail = f"{error}; what is learned of joints' zeros is lost at the end"
        if detail:
            self._emit({"kind": EventKind.NOTE, "detail": detail})

    def close(self) -> None:
        """Keep what was learned, and wait until it is written, unless the disk does not answer."""
        self._warn(self.kept.finish())
        self.keep(at_once=True)
        self._warn(self.kept.finish())

    def keep(self, at_once: bool = False) -> None:
        """Write what was learned, once a minute or ``at_once``."""
        self._warn(self.kept.step(self.slips, self._configuration, at_once))

    def _warn(self, detail: str) -> None:
        if detail:
            self._emit({"kind": EventKind.WARNING, "what": "rests_not_kept", "detail": detail})

    def configure(self, new: Configuration) -> None:
        """Take what the next loop runs with; what was learned stays while it is the same."""
        same = new.fingerprint == self._configuration.fingerprint
        self._configuration = new
        if same:
            self.slips.interrupt()
        else:
            self.slips = self._slip_watch()
        self.keep(at_once=True)

    def take(self, rows: Array) -> None:
        """Look for slips in cycles (k, width); hold for one."""
        for event in self.slips.take(rows):
            if event["kind"] != EventKind.SLIP:
                self._emit(event)
                continue
            self._hold(event)
            self.keep(at_once=True)

    def _hold(self, event: Event) -> None:
        """Emit an event, and hold for it: under a number below that of any answer to the event."""
        number = self._commands.number()
        self._emit(event)
        self._commands.ask(Command.ZERO_MOVED, number)

    def check(self) -> None:
        """Hold if a verification has failed, until its mark is removed, or for an earlier slip."""
        slip = self.kept.slip_of_earlier_run()
        if slip is not None:
            self._hold(slip)
        event = self.verification.look()
        if event is None:
            return
        if not event["holds"]:
            self._hold(event)
            return
        self._emit(event)
        if not self._status.latched:
            self._commands.ask(Command.DISARM)  # else a person's, who sees what else is latched

    def obstacle_to(self, command: Command, moved: bool, acknowledges: bool) -> str:
        """Return why a person's request must not reach the loop, as text; empty: it may.

        ``moved``: a zero had, before the request was logged; ``acknowledges``: the request
        acknowledges it.
        """
        if acknowledges:
            self.verification.acknowledge()
        if acknowledges or not moved:
            self.check()
        if acknowledges and moved:
            self.slips.reset()
            self.keep(at_once=True)
        if command != Command.ARM:
            return ""
        if reason := self._status.zero_moved:
            return f"{reason}; acknowledge it first: gapbridge disarm"
        return self.verification.blocked
