"""The rig of the link at hand for all tests of it: what is started once need not be each time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.faults.links import LINKS, Link
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Result

INLIER = 125.0  # Hz of the UR links: what a busy machine still keeps up with


def quiet_link(name: str) -> Link:
    """Return a link at a rate that a small machine keeps up with."""
    return LINKS[name](INLIER if name.startswith("ur_") else None)


def judge(result: Result, wrong: Sequence[str] | None = None) -> None:
    """Fail where a fault did not end as the table says; skip where the machine itself was late.

    ``wrong``: what counts of what is not as it must be; none: all. A violation always fails.
    """
    wrong = result.wrong if wrong is None else wrong
    if result.violated:
        pytest.fail(f"an invariant is broken: {result.wrong}")
    if wrong and not result.judged:
        pytest.skip(f"the machine was {1e3 * result.late:.0f} ms late: not judged: {wrong}")
    assert not wrong, wrong


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
