"""Jogs a simulated arm, and brings its tool into contact with a fixed object."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field

import numpy as np
from cell_operator import TIMEOUT, CellOperator, Terminal
from numpy.typing import NDArray

from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

Array = NDArray[np.float64]
AT_POSE = 1e-4  # m, of the TCP from its commanded position
CONTACT = 3e-5  # m, distance that counts as contact
SAMPLES = 8  # of the tracker, averaged


@dataclass
class JoggingOperator:
    """Jogs the arm and measures the true pose of its tool."""

    operator: CellOperator
    model: Model  # nominal arm with the true tool
    q: Array = field(default_factory=lambda: np.zeros(6))

    def jog(self, q: Array) -> None:
        """Move the arm to joints ``q`` (n,), rad, and wait until it has arrived."""
        self.q = np.asarray(q, dtype=float)
        self.operator.jog(self.q)
        target = self.model.rigid_pose(self.q[None]).position[0]
        until = time.monotonic() + TIMEOUT
        while np.linalg.norm(self._rigid() - target) > AT_POSE:
            assert time.monotonic() < until, "the simulated arm does not come to its pose"
            time.sleep(0.02)

    def _rigid(self) -> Array:
        return np.array(json.loads(self.operator.bench("truth"))["rigid_tcp"][:3])

    def pose(self) -> tuple[Array, Array]:
        """Return the measured TCP position (3,), m, and rotation (3, 3), in base."""
        rows = [self.operator.bench("measure").split(",")[1:] for _ in range(SAMPLES)]
        sample = np.mean(np.array(rows, dtype=float), axis=0)
        return sample[:3], rotation_matrix(sample[3:])

    def touch(self, q: Array, centre: Array, radius: float = 0.0) -> None:
        """Bring the TCP to a point, or to ``radius`` (m) from it, starting at joints ``q`` (n,)."""
        q = np.asarray(q, dtype=float)
        for _ in range(12):
            self.jog(q)
            offset = self.pose()[0] - centre
            distance = float(np.linalg.norm(offset))
            error = offset - (radius / distance * offset if radius else 0.0)
            if np.linalg.norm(error) < CONTACT:
                return
            J = self.model.linear_form(q[None]).jacobian[0][:3]
            q = q - np.linalg.pinv(J) @ error
        raise AssertionError(f"the tip does not come nearer than {np.linalg.norm(error):g} m")


def answer_questions(terminal: Terminal, answers: dict[str, object], most: int = 400) -> str:
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
