"""One cycle as a row of numbers: the loop fills it, the recorder takes it apart."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.state import RobotState

OPTIONAL = ("ft_raw_wrench", "joint_temperatures", "actual_current_as_torque", "payload_cog")


def write_cycle(
    row: Array,
    slices: Mapping[str, slice],
    state: RobotState,
    nominal_q: Array,
    corrected_q: Array,
    offset_in_base: Array,
) -> None:
    """Write a state and its setpoint into ``row``; NaN where the controller lacks a field."""
    row[1] = state.timestamp
    row[slices["target_q"]] = state.target_q
    row[slices["actual_q"]] = state.actual_q
    row[slices["actual_qd"]] = state.actual_qd
    row[slices["actual_TCP_force"]] = state.actual_TCP_force
    row[slices["payload"]] = np.nan if state.payload is None else state.payload
    for name in OPTIONAL:
        value = getattr(state, name)
        row[slices[name]] = np.nan if value is None else value
    row[slices["nominal_q"]] = nominal_q
    row[slices["corrected_q"]] = corrected_q
    row[slices["offset"]] = offset_in_base
    at = slices["received"].start
    row[at] = state.received
    at = slices["robot_mode"].start
    row[at : at + 5] = (
        state.robot_mode, state.safety_mode, state.runtime_state, state.safety_status_bits,
        state.speed_scaling,
    )  # fmt: skip
