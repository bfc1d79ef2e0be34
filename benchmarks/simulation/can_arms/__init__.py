"""The simulated arms on CAN: what is each one's own, a file an arm.

The bus, its faults and the driver's edge are the same for all (benchmarks/simulation/can.py).
"""

from __future__ import annotations

from benchmarks.simulation.can_arms.arm import CanArm
from benchmarks.simulation.can_arms.odrive import Odrive
from benchmarks.simulation.can_arms.openarm import OpenArm
from benchmarks.simulation.can_arms.piper import Piper

ARMS: dict[str, type[CanArm]] = {"can": Piper, "odrive": Odrive, "openarm": OpenArm}
"""Link -> its arm."""
