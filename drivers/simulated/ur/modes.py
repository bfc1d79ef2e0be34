"""Numbers of the controller's modes and states, and their names on the dashboard.

Source: Universal Robots, RTDE guide and dashboard server guide.
"""

from __future__ import annotations

from typing import Any

# runtime_state
STOPPED, PLAYING, PAUSED = 1, 2, 4

# robot_mode
POWER_OFF, POWER_ON, IDLE, BACKDRIVE, RUNNING = 3, 4, 5, 6, 7
ROBOT_MODE_NAMES = dict(enumerate((
    "NO_CONTROLLER", "DISCONNECTED", "CONFIRM_SAFETY", "BOOTING", "POWER_OFF", "POWER_ON", "IDLE",
    "BACKDRIVE", "RUNNING",
), -1))  # fmt: skip

# safety_mode
SAFETY_NORMAL, SAFETY_REDUCED, SAFETY_PROTECTIVE, SAFETY_ROBOT_EMERGENCY = 1, 2, 3, 7
SAFETY_MODE_NAMES = dict(enumerate((
    "NORMAL", "REDUCED", "PROTECTIVE_STOP", "RECOVERY", "SAFEGUARD_STOP", "SYSTEM_EMERGENCY_STOP",
    "ROBOT_EMERGENCY_STOP", "VIOLATION", "FAULT",
), 1))  # fmt: skip

#: safety_status_bits: 0 normal, 1 reduced, 2 protective stop, 6 robot emergency, 7 emergency,
#: 10 stopped due to safety.
SAFETY_BITS = {
    SAFETY_NORMAL: 1,
    SAFETY_REDUCED: 2,
    SAFETY_PROTECTIVE: 1 << 2 | 1 << 10,
    SAFETY_ROBOT_EMERGENCY: 1 << 6 | 1 << 7 | 1 << 10,
}

#: Memory of a controller that is on, with brakes released, and has nothing to do.
AT_REST: dict[str, Any] = {
    "robot_mode": RUNNING,
    "safety_mode": SAFETY_NORMAL,
    "safety_status": SAFETY_NORMAL,
    "safety_status_bits": SAFETY_BITS[SAFETY_NORMAL],
    "joint_mode": (253,) * 6,
    "speed_scaling": 1.0,
    "target_speed_fraction": 1.0,
    "speed_slider_fraction": 1.0,
    "actual_main_voltage": 48.0,
    "actual_robot_voltage": 48.0,
    "actual_joint_voltage": (47.8,) * 6,
    "actual_robot_current": 0.8,
    "actual_current_window": (3.0,) * 6,
    "actual_execution_time": 0.3,
    "tool_mode": 253,
}
