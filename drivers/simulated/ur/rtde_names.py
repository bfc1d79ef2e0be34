"""Names and types of every RTDE field: the public RTDE guide's tables.

Source: Universal Robots, 'Real-Time Data Exchange (RTDE) Guide', tables of robot controller outputs
and inputs (e-Series).
"""

from __future__ import annotations

#: Format character (struct, big-endian) and number of elements of each wire type.
FORMATS: dict[str, tuple[str, int]] = {
    "DOUBLE": ("d", 1),
    "VECTOR3D": ("3d", 3),
    "VECTOR6D": ("6d", 6),
    "INT32": ("i", 1),
    "UINT32": ("I", 1),
    "UINT64": ("Q", 1),
    "UINT8": ("B", 1),
    "BOOL": ("?", 1),
    "VECTOR6INT32": ("6i", 6),
    "VECTOR6UINT32": ("6I", 6),
}

REGISTERS = 48
BIT_REGISTERS = 128


def _fields(**names: str) -> dict[str, str]:
    """Return the type of each field; ``names`` of the fields of a type, between blanks."""
    return {name: wire_type for wire_type, many in names.items() for name in many.split()}


def _registers(direction: str) -> dict[str, str]:
    """Return the names of all registers of one direction, ``input`` or ``output``."""
    names = _fields(UINT32=f"{direction}_bit_registers0_to_31 {direction}_bit_registers32_to_63")
    names |= {f"{direction}_bit_register_{i}": "BOOL" for i in range(BIT_REGISTERS)}
    names |= {f"{direction}_int_register_{i}": "INT32" for i in range(REGISTERS)}
    return names | {f"{direction}_double_register_{i}": "DOUBLE" for i in range(REGISTERS)}


_MOTION = _fields(
    DOUBLE=(
        "timestamp tcp_force_scalar payload joint_position_deviation_ratio "
        "collision_detection_ratio actual_momentum"
    ),
    VECTOR3D="elbow_position elbow_velocity payload_cog actual_tool_accelerometer target_gravity",
    VECTOR6D=(
        "target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
        "actual_current actual_current_window actual_current_as_torque joint_control_output "
        "actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed "
        "actual_TCP_acceleration target_TCP_acceleration joint_temperatures tcp_offset "
        "payload_inertia ft_raw_wrench wrench_calc_from_currents target_base_acceleration "
        "target_base_wrench"
    ),
)
_STATE = _fields(
    DOUBLE="actual_execution_time target_execution_time speed_scaling target_speed_fraction",
    INT32="robot_mode safety_mode safety_status time_scale_source",
    UINT32="runtime_state robot_status_bits safety_status_bits script_control_line",
    UINT64="control_step",
    VECTOR6INT32="joint_mode",
)
_ELECTRICAL = _fields(
    DOUBLE=(
        "actual_main_voltage actual_robot_voltage actual_robot_current "
        "actual_robot_energy_consumed actual_robot_braking_energy_dissipated "
        "standard_analog_input0 standard_analog_input1 standard_analog_output0 "
        "standard_analog_output1 io_current euromap67_24V_voltage euromap67_24V_current "
        "tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature"
    ),
    VECTOR6D="actual_joint_voltage",
    INT32="encoder0_raw encoder1_raw tool_output_voltage",
    UINT32=(
        "analog_io_types euromap67_input_bits euromap67_output_bits tool_mode "
        "tool_analog_input_types"
    ),
    UINT64=(
        "actual_digital_input_bits actual_digital_output_bits "
        "actual_configurable_digital_input_bits actual_configurable_digital_output_bits"
    ),
    UINT8="tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
)

#: Every output field: name -> type. Input registers can be read back.
OUTPUTS: dict[str, str] = (
    _MOTION | _STATE | _ELECTRICAL | _registers("output") | _registers("input")
)

#: Every input field: name -> type.
INPUTS: dict[str, str] = _registers("input") | _fields(
    DOUBLE="speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    VECTOR6D="external_force_torque",
    UINT32="speed_slider_mask",
    UINT8=(
        "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
        "configurable_digital_output tool_digital_output_mask tool_digital_output "
        "standard_analog_output_mask standard_analog_output_type"
    ),
)


def blank(wire_type: str) -> float | int | tuple[float, ...]:
    """Return the zero of a wire type."""
    form, count = FORMATS[wire_type]
    if count > 1:
        return (0.0,) * count if form.endswith("d") else (0,) * count
    return 0.0 if form == "d" else 0
