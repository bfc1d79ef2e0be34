"""A technician who brings the simulated arm's tool to where an instrument wants it."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from technician import PATIENCE, Hands, Terminal

from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

Array = NDArray[np.float64]
THERE = 1e-4  # m: nearer than this to where it was sent, the arm has arrived
TOUCHING = 3e-5  # m: as near as a probe is brought by hand
LOOKS = 8  # of the tracker, averaged


@dataclass
class BenchHand:
    """Jogs the arm and looks at its tool, as it truly is."""

    hands: Hands
    model: Model  # of the arm as drawn, with the tool that it truly has
    q: Array = field(default_factory=lambda: np.zeros(6))

    def jog(self, q: Array) -> None:
        """Move the arm, and wait until it stands there."""
        self.q = np.asarray(q, dtype=float)
        self.hands.jog(self.q)
        wanted = self.model.rigid_pose(self.q[None]).position[0]
        until = time.monotonic() + PATIENCE
        while np.linalg.norm(self._rigid() - wanted) > THERE:
            assert time.monotonic() < until, "the simulated arm does not come to its pose"
            time.sleep(0.02)

    def _rigid(self) -> Array:
        return np.array(json.loads(self.hands.bench("truth"))["rigid_tcp"][:3])

    def pose(self) -> tuple[Array, Array]:
        """Return the true TCP (3,) and its rotation (3, 3), base, as a tracker sees them."""
        rows = [self.hands.bench("measure").split(",")[1:] for _ in range(LOOKS)]
        seen = np.mean(np.array(rows, dtype=float), axis=0)
        return seen[:3], rotation_matrix(seen[3:])

    def touch(self, q: Array, centre: Array, radius: float = 0.0) -> None:
        """Bring the TCP onto a point, or to ``radius`` from it, beginning at joints ``q`` (n,)."""
        q = np.asarray(q, dtype=float)
        for _ in range(12):
            self.jog(q)
            apart = self.pose()[0] - centre
            distance = float(np.linalg.norm(apart))
            left = apart - (radius / distance * apart if radius else 0.0)
            if np.linalg.norm(left) < TOUCHING:
                return
            J = self.model.linear_form(q[None]).jacobian[0][:3]
            q = q - np.linalg.pinv(J) @ left
        raise AssertionError(f"the tip does not come nearer than {np.linalg.norm(left):g} m")


def lead(terminal: Terminal, answers: dict[str, object], most: int = 400) -> str:
    """Answer questions until the command ends; returns all that was shown.

    ``answers``: part of a question -> a line, or a callable that is given the terminal and returns
    the line (None: nothing is typed).
    """
    for _ in range(most):
        question = terminal.question()
        if question is None:
            return terminal.shown
        found = [a for part, a in answers.items() if part in question]
        assert found, f"nobody expected {question!r} after {terminal.shown[-1500:]}"
        line = found[0](terminal) if callable(found[0]) else found[0]
        if line is not None:
            terminal.type(str(line))
    raise AssertionError(f"{most} questions, and no end: {terminal.shown[-2000:]}")
