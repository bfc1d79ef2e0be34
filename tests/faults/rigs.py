"""The rig of the link at hand for all tests of it: what is started once need not be each time."""

from __future__ import annotations

from pathlib import Path

from benchmarks.faults.links import LINKS, Link
from benchmarks.faults.rig import Rig

INLIER = 125.0  # Hz of the UR links: what a busy machine still keeps up with


def quiet_link(name: str) -> Link:
    """Return a link at a rate that a small machine keeps up with."""
    return LINKS[name](INLIER if name.startswith("ur_") else None)


class Rigs:
    """One rig at a time; one that a fault has left beyond recovery is replaced."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rig: Rig | None = None
        self._name = ""

    def of(self, name: str) -> Rig:
        """Return a rig of a link whose daemon runs."""
        if self._rig is None or self._name != name or not self._rig.run.alive:
            self.close()
            self._rig, self._name = Rig(quiet_link(name), self._folder / name), name
            self._rig.__enter__()
        return self._rig

    def close(self) -> None:
        """End the rig at hand."""
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.__exit__(None, None, None)
