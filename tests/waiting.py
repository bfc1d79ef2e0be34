"""Which tests mostly wait for processes and wires, and which of ``make test`` run them."""

from __future__ import annotations

WAIT = (
    "bridge/calibration/report/test_calibration_report_browser.py",
    "bridge/cli/test_cli_check.py",
    "bridge/cli/test_cli_init.py",
    "bridge/daemon/test_configuration_that_runs.py",
    "bridge/daemon/test_control.py",
    "bridge/daemon/test_daemon_checks.py",
    "bridge/daemon/test_daemon_faults.py",
    "bridge/daemon/test_daemon_writing.py",
    "bridge/daemon/test_owner_lock.py",
    "bridge/daemon/test_reload.py",
    "bridge/daemon/test_service_manager.py",
    "bridge/daemon/test_side_attack.py",
    "bridge/daemon/test_withdrawal.py",
    "bridge/demo/",
    "bridge/ipc/test_side_process.py",
    "bridge/loop/test_loop_parts.py",
    "bridge/loop/test_loop_writing.py",
    "bridge/loop/test_replayed_loop.py",
    "bridge/metrics/",
    "bridge/recording/test_recorder_process.py",
    "bridge/recording/test_recording_daemon.py",
    "bridge/recording/test_replay.py",
    "bridge/report/test_report_browser.py",
    "bridge/served/",
    "bridge/setpoint_source/",
    "bridge/web/",
    "drivers/can/",
    "drivers/canopen/",
    "drivers/contract/",
    "drivers/ft_sensor/",
    "drivers/modbus/",
    "drivers/simulated/",
    "drivers/ur_rtde/",
    "faults/test_matrix.py",
    "faults/test_short.py",
    "faults/test_start.py",
    "hil/",
)
"""Files and folders whose tests run processes, buses, browsers or servers."""
COMPUTE = (
    "bridge/demo/test_demo_hidden.py",
    "bridge/demo/test_demo_parts.py",
    "bridge/demo/test_droop.py",
    "drivers/can/test_can_profile.py",
    "drivers/can/test_can_sample.py",
    "drivers/canopen/test_canopen_profile.py",
    "drivers/ft_sensor/test_ft_fuzz.py",
    "drivers/modbus/test_modbus_profile.py",
    "drivers/modbus/test_modbus_registers.py",
    "drivers/modbus/test_modbus_writers.py",
    "drivers/simulated/test_simulated_plant.py",
    "drivers/ur_rtde/test_ur_allowed.py",
    "drivers/ur_rtde/test_ur_nominal.py",
)
"""Files in these folders whose tests compute."""
WAITING = ("gw0", "gw1")  # processes of xdist that run them
NICE = 2  # of its other processes, which compute with what is left of the cores


def waits(file: str) -> bool:
    """Return whether the tests of a file (or one of them), seen from the root, mostly wait."""
    place = file.removeprefix("tests/")
    return place.startswith(WAIT) and not place.startswith(COMPUTE)
