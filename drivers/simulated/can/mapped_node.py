"""A simulated arm from a profile alone: it sends and executes what the map defines.

It shows a map at work before the arm is there. Being made of the same map, it cannot show that the
map is right.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.profile import Check, Incoming, Outgoing
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.robot_modes import StopReason
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController

HEALTHY_EVERY = 5  # cycles between messages that are not part of a sample


class MappedNodes(CanNodes):
    """Every message that the profile reads is sent; its setpoint frames move the arm."""

    def __init__(self, link: CanSettings, host: str, controller: ArmController) -> None:
        super().__init__(link, host, controller)
        self._profile = read_profile(link.profile_path, link.installation)
        self._enabled = False
        self._cycles = self._samples = 0
        self._wire = (
            self._profile.joints.to_wire(np.array(controller.q)) if self._profile.writes else None
        )
        self._enabling = self._sequence(self._profile.enable)
        self._setpoint = {f.key[0]: f for f in self._profile.setpoint}
        self._asked = {(f.key[0], f.encode()) for f in self._profile.request}

    @staticmethod
    def _sequence(actions: Any) -> set[tuple[int, bytes]]:
        return {(f.key[0], f.encode()) for action in actions for f in action.frames}

    def take(self, identifier: int, data: bytes, controller: ArmController) -> None:
        """Execute the enable sequence and setpoints; answer requests."""
        if (identifier, data) in self._asked:
            if (identifier, data) == max(self._asked):
                self._send_sample(controller)
        elif (identifier, data) in self._enabling:
            self._enabled = True
        elif identifier in self._setpoint:
            self._set_target(self._setpoint[identifier], data, controller)

    def _set_target(self, frame: Outgoing, data: bytes, controller: ArmController) -> None:
        if self._wire is None or len(data) != frame.message.length:
            return
        if self._enabling and not self._enabled:
            return
        values = frame.message.decode(data, decode_choices=False)
        for signal, joint in frame.joints:
            self._wire[joint] = values[signal]
        joints = self._profile.joints
        if frame.joints and joints.setpoint_scale is not None:
            controller.command(tuple(self._wire * joints.setpoint_scale + joints.zero))

    def publish(self, controller: ArmController) -> None:
        """Send the sample, unless it must be requested, and less often all other messages."""
        if not self._asked:
            self._send_sample(controller)
        if self._cycles % HEALTHY_EVERY == 0:
            for key, incoming in self._profile.incoming.items():
                if key not in self._profile.sample:
                    self.send(key[0], self._encode(incoming, controller))
        self._cycles += 1

    def _send_sample(self, controller: ArmController) -> None:
        self.begin_sample()
        self._samples += 1
        for key in self._profile.sample:
            self.send(key[0], self._encode(self._profile.incoming[key], controller))

    def _encode(self, incoming: Incoming, controller: ArmController) -> bytes:
        """Return a message with the present joints and normal status."""
        profile, values = self._profile, {s.name: 0.0 for s in incoming.message.signals}
        reported = {
            "position": np.array(self._kept) + self._shift - profile.joints.zero,
            "velocity": np.array(controller.qd),
            "torque": np.array(controller.joint_torque),
            "temperature": np.array(controller.temperatures),
        }
        for reading in incoming.readings:
            scale = profile.joints.scale[reading.quantity][reading.joint]
            values[reading.signal] = reported[reading.quantity][reading.joint] / scale
        for check in incoming.checks:
            values[check.signal] = min(check.normal)
        for signal in incoming.enabled:
            yes = min(profile.enabled_values)
            values[signal] = yes if self._enabled else (0 if yes else 1)
        for check in () if controller.can_move else incoming.checks:  # may be in the same signal
            values[check.signal] = _stopped(check, controller.emergency)
        if incoming.counter is not None:
            length = incoming.message.get_signal_by_name(incoming.counter).length
            values[incoming.counter] = self._samples % (1 << length)
        return bytes(incoming.message.encode(values, strict=False))


def _stopped(check: Check, emergency: bool) -> int:
    """Return the value that reports a stop: of its kind where the profile names one."""
    kind = StopReason.EMERGENCY_STOP if emergency else StopReason.PROTECTIVE_STOP
    named = [value for value, reason in check.values.items() if reason == kind]
    unknown = (value for value in range(len(check.normal) + 1) if check.stop_reason(value))
    return named[0] if named else next(unknown)
