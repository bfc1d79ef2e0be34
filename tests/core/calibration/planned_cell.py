"""A small cell to plan in: a UR5e with a tracker before it."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.predicted_readings import unmeasured_readings
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload, Plan
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.workspace.workspace import Place, Workspace

SIGMA = 3e-5
LOADS = (Payload(4.0, (0.0, 0.02, 0.06), "plate"), Payload(0.0))
POSITION = make_observable("position")


def small_model() -> Model:
    """Return the arm and its tool."""
    tool = np.eye(4)
    tool[:3, 3] = [0.03, 0.02, 0.15]
    return Model(builtin_arm("ur5e"), tool)


def small_space(model: Model, **given: object) -> Workspace:
    """Return a floor and a tracker."""
    room = {"floor": 0.0, "places": [Place((2.0, 0.5, 0.6), 0.3)], **given}
    return Workspace.of(model, **room)  # type: ignore[arg-type]


def small_parameters(model: Model) -> Parameters:
    """Return few parameters, for tests that need no more."""
    effects = ("tool_frame", "joint_offset", "axial_compliance")
    return identifiable_parameters(model, effects, observable=POSITION)


def readings_of(plan: Plan, kind: str = "position") -> Readings:
    """Return the readings, without values, that a plan asks for."""
    load = np.array([pose.load for pose in plan.poses])
    loads = Loads(
        payload_mass=np.array([one.mass for one in plan.loads])[load],
        payload_cog=np.array([one.cog for one in plan.loads], dtype=float)[load],
        approach=np.array([pose.approach for pose in plan.poses]),
    )
    readings = unmeasured_readings(
        kind, np.array([pose.q for pose in plan.poses]), loads, load=load,
        station=np.array([pose.station for pose in plan.poses]),
        target=np.array([pose.target for pose in plan.poses]),
        pose=np.array([pose.number for pose in plan.poses]),
    )  # fmt: skip
    readings.held_out[:] = [pose.held_out for pose in plan.poses]
    return readings
