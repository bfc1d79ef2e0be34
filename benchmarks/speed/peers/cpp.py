"""The C++ peer, compiled when the benchmark runs, where there is a compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import Chain, Rows

Array = NDArray[np.float64]
FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-shared", "-fPIC")


class _Arm(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p)
        for name in ("rotation", "position", "tool", "mass", "cog", "gravity", "compliance")
    ]


def compiler() -> str | None:
    """Return the C++ compiler of this machine, or None."""
    return next(
        (found for name in ("g++", "clang++", "c++") if (found := shutil.which(name))), None
    )


class Cpp:
    """The compiled peer for one arm of six joints. Raises RuntimeError without a compiler."""

    def __init__(self, chain: Chain) -> None:
        if (found := compiler()) is None:
            raise RuntimeError("no C++ compiler")
        library = Path(tempfile.mkdtemp(prefix="gapbridge-speed-")) / "rows.so"
        source = Path(__file__).with_name("rows.cpp")
        subprocess.run([found, *FLAGS, "-o", library, source], check=True)
        self._library: Any = ctypes.CDLL(str(library))
        tool = np.concatenate([chain.tool_rotation.ravel(), chain.tool_position])
        self._kept = [chain, tool]
        self._arm = _Arm(
            chain.rotation.ctypes.data, chain.position.ctypes.data, tool.ctypes.data,
            chain.mass.ctypes.data, chain.cog.ctypes.data, chain.gravity.ctypes.data,
            chain.compliance.ctypes.data,
        )  # fmt: skip

    @staticmethod
    def _pointers(rows: Rows) -> list[ctypes.c_void_p]:
        parts = (rows.q, rows.payload_mass, rows.payload_cog, rows.wrench)
        return [ctypes.c_void_p(part.ctypes.data) for part in parts]

    def normal(self, rows: Rows, gap: Array, G: Array) -> None:
        """Add the products of [regressor | gap] to G (13, 13), lower triangle."""
        self._library.normal(
            self._arm, *self._pointers(rows), ctypes.c_void_p(gap.ctypes.data),
            ctypes.c_long(len(rows.q)), ctypes.c_void_p(G.ctypes.data),
        )  # fmt: skip

    def setpoint(self, q: Array, row: Rows, damping: float, found: Array) -> Any:
        """Return a call without arguments that writes step and deflection (9,) for ``q`` (6,)."""
        function = self._library.setpoint
        function.restype = None
        mass = ctypes.c_double(float(row.payload_mass[0]))
        given = (
            self._arm, ctypes.c_void_p(q.ctypes.data), mass,
            ctypes.c_void_p(row.payload_cog.ctypes.data), ctypes.c_void_p(row.wrench.ctypes.data),
            ctypes.c_double(damping), ctypes.c_void_p(found.ctypes.data),
        )  # fmt: skip
        return lambda: function(*given)
