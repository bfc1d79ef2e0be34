"""The side processes of a run: recorder, status page and metrics, managed together."""

from __future__ import annotations

from collections.abc import Callable
from typing import IO, Any

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.drivers.clock import Clock

SIDE_PROCESSES: dict[str, tuple[str, Callable[[DaemonSettings], bool]]] = {
    "recorder": ("gapbridge.bridge.recording.main", lambda s: s.recording.folder is not None),
    "web": ("gapbridge.bridge.web.main", lambda s: s.web is not None),
    "metrics": ("gapbridge.bridge.metrics.main", lambda s: s.metrics is not None),
}
"""Name -> (module to run, whether a run's settings enable it)."""

END_TIMEOUTS = {"recorder": 10.0}  # s to finish in after the daemon's end, by name
DEFAULT_END_TIMEOUT = 0.3  # s, of the others


class SideProcesses:
    """All side processes of a run."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._running: dict[str, SideProcess] = {}
        self._start_data: dict[str, Any] = {}  # of all, also of those that are started again

    def start(
        self,
        configuration: Configuration,
        session: str,
        memory: SharedMemory,
        log: IO[Any] | int,
    ) -> None:
        """Start those that the settings enable."""
        settings = configuration.settings
        data = self._start_data
        data.update(_start_data(configuration), n=configuration.n, session=session)
        for name, (module, is_enabled) in SIDE_PROCESSES.items():
            if is_enabled(settings):
                self._running[name] = SideProcess(module, data, memory, self._clock, log)

    def configure(self, new: Configuration) -> None:
        """Pass on what the next loop runs with, unless it is the same; for later starts, too."""
        data = _start_data(new)
        if data.items() <= self._start_data.items():
            return
        self._start_data.update(data)
        self.emit({"kind": EventKind.CELL, **data["extra"]})

    def show(self, memory: SharedMemory) -> None:
        """Switch all of them to another memory."""
        for side in self._running.values():
            side.show(memory)

    def emit(self, event: dict[str, Any]) -> None:
        """Pass an event on to each; never blocks."""
        for side in self._running.values():
            side.emit(event)

    def check(self) -> list[dict[str, Any]]:
        """Check and restart them; returns their events, and events on their problems."""
        events = []
        for name, side in self._running.items():
            events += [_checked(name, event) for event in side.events()]
            if (problem := side.check()) is not None:
                events.append({"kind": EventKind.SIDE, "side": name, "detail": problem})
        return events

    def status(self) -> dict[str, dict[str, int | None]]:
        """Return process id, restarts, stalls and events dropped of each."""
        return {
            name: {
                "pid": side.pid, "restarts": side.restarts, "stalls": side.stalls,
                "dropped": side.dropped,
            }
            for name, side in self._running.items()
        }  # fmt: skip

    def close(self, emit: Callable[[dict[str, Any]], object]) -> None:
        """Notify all that the daemon ends, and wait until they have finished.

        Then emits their last events, and one on each that had something to finish and did not.
        """
        events = []
        for side in self._running.values():
            side.begin_close()
        for name, side in self._running.items():
            last, problem = side.close(END_TIMEOUTS.get(name, DEFAULT_END_TIMEOUT))
            events += [_checked(name, event) for event in last]
            if problem is not None and name in END_TIMEOUTS:
                events.append({"kind": EventKind.SIDE, "side": name, "detail": problem})
        self._running.clear()
        for event in events:
            emit(event)


def _start_data(configuration: Configuration) -> dict[str, Any]:
    """Return the part of the start data that a reload changes."""
    return {
        "settings": configuration.settings.model_dump(mode="json"),
        "extra": {"text": configuration.text, "digests": configuration.digests},
    }


def _checked(name: str, event: dict[str, Any]) -> dict[str, Any]:
    """Return an event of a side process, which may emit only events of its own kind."""
    if event.get("kind") == name:
        return event
    detail = f"{name} emitted {str(event.get('kind'))[:40]!r}, which is not its own"
    return {"kind": EventKind.SIDE, "side": name, "detail": detail}
