"""Names and types of every RTDE field: the public RTDE guide's tables.

Source: Universal Robots, 'Real-Time Data Exchange (RTDE) Guide', tables of robot controller outputs
and inputs (e-Series).
"""

from __future__ import annotations

DOUBLE = "DOUBLE"
VECTOR3D = "VECTOR3D"
VECTOR6D = "VECTOR6D"
INT32 = "INT32"
UINT32 = "UINT32"
UINT64 = "UINT64"
UINT8 = "UINT8"
BOOL = "BOOL"
VECTOR6INT32 = "VECTOR6INT32"
VECTOR6UINT32 = "VECTOR6UINT32"

#: Format character (struct, big-endian) and number of elements of each wire type.
FORMATS: dict[str, tuple[str, int]] = {
    DOUBLE: ("d", 1),
    VECTOR3D: ("3d", 3),
    VECTOR6D: ("6d", 6),
    INT32: ("i", 1),
    UINT32: ("I", 1),
    UINT64: ("Q", 1),
    UINT8: ("B", 1),
    BOOL: ("?", 1),
    VECTOR6INT32: ("6i", 6),
    VECTOR6UINT32: ("6I", 6),
}

REGISTERS = 48
BIT_REGISTERS = 128


def _registers(direction: str) -> dict[str, str]:
    """Return the names of all registers of one direction, ``input`` or ``output``."""
    names = {
        f"{direction}_bit_registers0_to_31": UINT32,
        f"{direction}_bit_registers32_to_63": UINT32,
    }
    names |= {f"{direction}_bit_register_{i}": BOOL for i in range(BIT_REGISTERS)}
    names |= {f"{direction}_int_register_{i}": INT32 for i in range(REGISTERS)}
    names |= {f"{direction}_double_register_{i}": DOUBLE for i in range(REGISTERS)}
    return names


_MOTION = {
    "timestamp": DOUBLE,
    "target_q": VECTOR6D,
    "target_qd": VECTOR6D,
    "target_qdd": VECTOR6D,
    "target_current": VECTOR6D,
    "target_moment": VECTOR6D,
    "actual_q": VECTOR6D,
    "actual_qd": VECTOR6D,
    "actual_current": VECTOR6D,
    "actual_current_window": VECTOR6D,
    "actual_current_as_torque": VECTOR6D,
    "joint_control_output": VECTOR6D,
    "actual_TCP_pose": VECTOR6D,
    "actual_TCP_speed": VECTOR6D,
    "actual_TCP_force": VECTOR6D,
    "target_TCP_pose": VECTOR6D,
    "target_TCP_speed": VECTOR6D,
    "actual_TCP_acceleration": VECTOR6D,
    "target_TCP_acceleration": VECTOR6D,
    "joint_temperatures": VECTOR6D,
    "elbow_position": VECTOR3D,
    "elbow_velocity": VECTOR3D,
    "tcp_force_scalar": DOUBLE,
    "tcp_offset": VECTOR6D,
    "payload": DOUBLE,
    "payload_cog": VECTOR3D,
    "payload_inertia": VECTOR6D,
    "ft_raw_wrench": VECTOR6D,
    "wrench_calc_from_currents": VECTOR6D,
    "joint_position_deviation_ratio": DOUBLE,
    "collision_detection_ratio": DOUBLE,
    "actual_momentum": DOUBLE,
    "actual_tool_accelerometer": VECTOR3D,
    "target_gravity": VECTOR3D,
    "target_base_acceleration": VECTOR6D,
    "target_base_wrench": VECTOR6D,
}

_STATE = {
    "actual_execution_time": DOUBLE,
    "target_execution_time": DOUBLE,
    "control_step": UINT64,
    "robot_mode": INT32,
    "joint_mode": VECTOR6INT32,
    "safety_mode": INT32,
    "safety_status": INT32,
    "speed_scaling": DOUBLE,
    "target_speed_fraction": DOUBLE,
    "runtime_state": UINT32,
    "robot_status_bits": UINT32,
    "safety_status_bits": UINT32,
    "script_control_line": UINT32,
    "time_scale_source": INT32,
}

_ELECTRICAL = {
    "actual_digital_input_bits": UINT64,
    "actual_digital_output_bits": UINT64,
    "actual_configurable_digital_input_bits": UINT64,
    "actual_configurable_digital_output_bits": UINT64,
    "encoder0_raw": INT32,
    "encoder1_raw": INT32,
    "actual_main_voltage": DOUBLE,
    "actual_robot_voltage": DOUBLE,
    "actual_robot_current": DOUBLE,
    "actual_joint_voltage": VECTOR6D,
    "actual_robot_energy_consumed": DOUBLE,
    "actual_robot_braking_energy_dissipated": DOUBLE,
    "analog_io_types": UINT32,
    "standard_analog_input0": DOUBLE,
    "standard_analog_input1": DOUBLE,
    "standard_analog_output0": DOUBLE,
    "standard_analog_output1": DOUBLE,
    "io_current": DOUBLE,
    "euromap67_input_bits": UINT32,
    "euromap67_output_bits": UINT32,
    "euromap67_24V_voltage": DOUBLE,
    "euromap67_24V_current": DOUBLE,
    "tool_mode": UINT32,
    "tool_analog_input_types": UINT32,
    "tool_analog_input0": DOUBLE,
    "tool_analog_input1": DOUBLE,
    "tool_output_voltage": INT32,
    "tool_output_current": DOUBLE,
    "tool_temperature": DOUBLE,
    "tool_output_mode": UINT8,
    "tool_digital_output0_mode": UINT8,
    "tool_digital_output1_mode": UINT8,
}

#: Every output field: name -> type. Input registers can be read back.
OUTPUTS: dict[str, str] = (
    _MOTION | _STATE | _ELECTRICAL | _registers("output") | _registers("input")
)

#: Every input field: name -> type.
INPUTS: dict[str, str] = _registers("input") | {
    "speed_slider_mask": UINT32,
    "speed_slider_fraction": DOUBLE,
    "standard_digital_output_mask": UINT8,
    "standard_digital_output": UINT8,
    "configurable_digital_output_mask": UINT8,
    "configurable_digital_output": UINT8,
    "tool_digital_output_mask": UINT8,
    "tool_digital_output": UINT8,
    "standard_analog_output_mask": UINT8,
    "standard_analog_output_type": UINT8,
    "standard_analog_output_0": DOUBLE,
    "standard_analog_output_1": DOUBLE,
    "external_force_torque": VECTOR6D,
}


def blank(wire_type: str) -> float | int | tuple[float, ...]:
    """Return the zero of a wire type."""
    form, count = FORMATS[wire_type]
    if count > 1:
        return (0.0,) * count if form.endswith("d") else (0,) * count
    return 0.0 if form == "d" else 0
