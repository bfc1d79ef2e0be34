"""The arm as a frame of finite elements (Pynite): truth that shares no formula with the model.

Each joint is a short round beam along its axis, centred on the joint's origin: it twists
(flexibility L / GJ) and bends (L / EI) under what hangs on it. Links are stiff or flexible round
beams from joint to joint; weights and pulls are nodal loads. First-order theory (small
displacements), as in the paper's simulation. Frames come from standard DH rows through scipy's
rotations; nothing is taken from core.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lu_factor, lu_solve
from scipy.spatial.transform import Rotation

JOINT = 2e-3  # m, length of a joint's beam: its own shear deflects by (JOINT / arm)^2 / 12 of all
STIFF = 1e10  # N m2 a metre: bending of a link that counts as rigid
STRETCH = 1e12  # N: EA of every beam; what it gives way along its axis is out of sight
REFINEMENTS = 4
SMALL = 1e-9  # m: nodes nearer than this are one


@dataclass(frozen=True)
class FrameArm:
    """What the frame is built from."""

    dh: list[dict]  # rows {a, alpha, d, offset, mass, cog}
    axial: np.ndarray  # (n,) rad/Nm
    radial: np.ndarray  # (n,) rad/Nm
    tool: np.ndarray  # (3,) m, TCP in the flange
    gravity: np.ndarray  # (3,) m/s2
    link_stiffness: float = STIFF  # N m2, EI of the links (GJ = 0.8 EI, as in a steel tube)


@dataclass(frozen=True)
class NodalLoad:
    """One load case: on the tool, and in the gripper."""

    wrench: np.ndarray  # (6,) at the TCP, base axes
    payload: float = 0.0  # kg
    payload_cog: np.ndarray | None = None  # (3,) m, flange axes


def rigid_frames(dh: list[dict], q: np.ndarray):
    """Return joint origins (n+1, 3) with the flange, axes (n, 3), centres (n, 3), flange turn."""
    turn, point = Rotation.identity(), np.zeros(3)
    origins, axes, centres = [], [], []
    for row, angle in zip(dh, q, strict=True):
        origins.append(point)
        axes.append(turn.apply([0, 0, 1]))
        turn = turn * Rotation.from_euler("z", angle + row.get("offset", 0.0))
        point = point + turn.apply([row["a"], 0, row["d"]])
        turn = turn * Rotation.from_euler("x", row["alpha"])
        centres.append(point + turn.apply(row.get("cog", np.zeros(3))))
    return np.array([*origins, point]), np.array(axes), np.array(centres), turn


class Frame:
    """One pose of an arm as a finite-element model."""

    def __init__(self, arm: FrameArm, q: np.ndarray, payload_cog: np.ndarray | None = None) -> None:
        from Pynite import FEModel3D  # takes most of a second to import

        self.arm, self.model = arm, FEModel3D()
        self._places: dict[str, str] = {}
        self.model.add_material("unit", 1.0, 1.0, 0.3, 0.0)
        origins, axes, centres, flange = rigid_frames(arm.dh, q)
        self.rigid_tcp = origins[-1] + flange.apply(arm.tool)
        half = JOINT / 2
        near, far = origins[:-1] - half * axes, origins[:-1] + half * axes
        self._node("near0", near[0])
        self.model.def_support("near0", *[True] * 6)
        for i in range(len(arm.dh)):
            self._node(f"far{i}", far[i])
            self._beam(f"joint{i}", f"near{i}", f"far{i}", JOINT / arm.radial[i],
                       JOINT / arm.axial[i])  # fmt: skip
            beyond = near[i + 1] if i + 1 < len(arm.dh) else origins[-1]
            end = f"near{i + 1}" if i + 1 < len(arm.dh) else "flange"
            self._node(end, beyond)
            self._link(f"link{i}", f"far{i}", end, np.linalg.norm(beyond - far[i]))
            self._hang(f"centre{i}", centres[i], f"far{i}", far[i])
        self._node("tcp", self.rigid_tcp)
        self._link("tool", "flange", "tcp", np.linalg.norm(arm.tool))
        cog = np.zeros(3) if payload_cog is None else payload_cog
        self._hang("payload", origins[-1] + flange.apply(cog), "flange", origins[-1])

    def _beam(self, name: str, start: str, end: str, bending: float, torsion: float) -> None:
        # E = G = 1, so that I and J are the stiffnesses themselves
        self.model.add_section(name, STRETCH, bending, bending, torsion)
        self.model.add_member(name, start, end, "unit", name)

    def _link(self, name: str, start: str, end: str, length: float) -> None:
        stiffness = self.arm.link_stiffness
        if stiffness == STIFF or name == "tool":
            # short and endlessly stiff beams drown all others in rounding errors
            stiffness = STIFF * length
        self._beam(name, start, end, stiffness, 0.8 * stiffness)

    def _node(self, name: str, point: np.ndarray) -> None:
        self.model.add_node(name, *(float(v) for v in point))

    def _hang(self, name: str, point: np.ndarray, on: str, on_point: np.ndarray) -> None:
        """Add a node on a bracket; how far a bracket bends moves no joint and no tool."""
        length = np.linalg.norm(point - on_point)
        self._places[name] = name if length > SMALL else on
        if length > SMALL:
            self._node(name, point)
            self._beam(f"bracket {name}", on, name, 1e6 * length, 1e6 * length)

    def deflection(self, loads: list[NodalLoad]) -> np.ndarray:
        """Return how the TCP moves and turns (N, 6) from the unloaded frame, base axes."""
        own = self.arm.gravity
        for k, load in enumerate(loads):
            for i, row in enumerate(self.arm.dh):
                self._force(self._places[f"centre{i}"], row.get("mass", 0.0) * own, k)
            self._force(self._places["payload"], load.payload * own, k)
            self._force("tcp", load.wrench[:3], k)
            for axis, value in zip("XYZ", load.wrench[3:], strict=True):
                self.model.add_node_load("tcp", f"M{axis}", float(value), f"{k}")
            self.model.add_load_combo(f"{k}", {f"{k}": 1.0})
        self.model.analyze_linear(check_stability=False)
        return self._refined(len(loads))

    def _refined(self, count: int) -> np.ndarray:
        """Return the TCP's displacements (N, 6), Pynite's own solution refined on its own matrix.

        Stiff links beside soft joints cost Pynite's solution about four digits; residuals taken
        in extended precision bring them back (Wilkinson). The equations stay Pynite's.
        """
        K = np.asarray(self.model.Ke("0", check_stability=False, sparse=False), dtype=float)
        held = 6 * self.model.nodes["near0"].ID
        free = np.delete(np.arange(len(K)), np.arange(held, held + 6))
        K = K[np.ix_(free, free)]
        P = np.column_stack([self.model.P(f"{k}") for k in range(count)])[free]
        D = np.column_stack([self.model.D(f"{k}") for k in range(count)])[free]
        exact, factors = K.astype(np.longdouble), lu_factor(K)
        wide = D.astype(np.longdouble)
        for _ in range(REFINEMENTS):
            wide += lu_solve(factors, (P - exact @ wide).astype(float))
        full = np.zeros((len(K) + 6, count))
        full[free] = wide
        start = 6 * self.model.nodes["tcp"].ID
        return full[start : start + 6].T

    def _force(self, node: str, force: np.ndarray, case: int) -> None:
        for axis, value in zip("XYZ", force, strict=True):
            self.model.add_node_load(node, f"F{axis}", float(value), f"{case}")
