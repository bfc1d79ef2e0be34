"""The state machine of one drive by CiA 402: Controlword in, Statusword out."""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """State -> the bits of the Statusword that report it."""

    NOT_READY = 0x0000
    SWITCH_ON_DISABLED = 0x0040
    READY = 0x0021
    SWITCHED_ON = 0x0023
    ENABLED = 0x0027
    QUICK_STOP = 0x0007
    REACTION = 0x000F
    FAULT = 0x0008


VOLTAGE = 0x0010  # Statusword: voltage enabled
REMOTE = 0x0200  # Statusword: the Controlword is executed


class Machine:
    """One drive's power state."""

    def __init__(self) -> None:
        self.phase = Phase.SWITCH_ON_DISABLED
        self.word = 0  # the last Controlword
        self._quick_stop_stays = False  # option codes 5 to 8 of 0x605A

    def set_quick_stop_option(self, code: int) -> None:
        """Set the option code of 0x605A."""
        self._quick_stop_stays = code >= 5

    def control(self, word: int) -> bool:
        """Execute a Controlword; returns whether it resets a fault."""
        rising = word & ~self.word
        self.word = word
        if self.phase in (Phase.FAULT, Phase.REACTION):
            if self.phase is Phase.FAULT and rising & 0x80:
                self.phase = Phase.SWITCH_ON_DISABLED
                return True
            return False
        if not word & 0x02:
            self._disable_voltage()
        elif not word & 0x04:
            self._quick_stop()
        elif not word & 0x01:
            self._shut_down()
        else:
            self._switch_on(bool(word & 0x08))
        return False

    def _disable_voltage(self) -> None:
        if self.phase is not Phase.NOT_READY:
            self.phase = Phase.SWITCH_ON_DISABLED

    def _quick_stop(self) -> None:
        if self.phase is Phase.ENABLED:
            self.phase = Phase.QUICK_STOP
        elif self.phase in (Phase.READY, Phase.SWITCHED_ON):
            self.phase = Phase.SWITCH_ON_DISABLED

    def _shut_down(self) -> None:
        if self.phase in (Phase.SWITCH_ON_DISABLED, Phase.SWITCHED_ON, Phase.ENABLED):
            self.phase = Phase.READY

    def _switch_on(self, enable: bool) -> None:
        """Make one transition per Controlword: a drive does not skip a state."""
        if self.phase is Phase.READY:
            self.phase = Phase.SWITCHED_ON
        elif self.phase is Phase.SWITCHED_ON and enable:
            self.phase = Phase.ENABLED
        elif self.phase is Phase.ENABLED and not enable:
            self.phase = Phase.SWITCHED_ON
        elif self.phase is Phase.QUICK_STOP and enable and self._quick_stop_stays:
            self.phase = Phase.ENABLED

    def fault(self) -> None:
        """Go to FAULT, through the fault reaction if the drive was moving."""
        moving = self.phase in (Phase.ENABLED, Phase.QUICK_STOP)
        self.phase = Phase.REACTION if moving else Phase.FAULT

    def end_braking(self) -> None:
        """End a quick stop or a fault reaction: the axis is at rest."""
        if self.phase is Phase.REACTION:
            self.phase = Phase.FAULT
        elif self.phase is Phase.QUICK_STOP and not self._quick_stop_stays:
            self.phase = Phase.SWITCH_ON_DISABLED

    @property
    def statusword(self) -> int:
        """Return the Statusword without the mode's bits."""
        return self.phase.value | VOLTAGE | REMOTE
