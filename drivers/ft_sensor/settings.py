"""Section ``ft_sensor`` of a cell: the sensor, its mounting, and its limits."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.section import Number, Section

Vector3 = tuple[Number, Number, Number]
STANDARD_IDS = 0x7FF


class SensorFrame(Section):
    """The sensor's frame in the flange frame."""

    xyz: Vector3 = Field((0.0, 0.0, 0.0), description="x, y, z in m")
    rpy: Vector3 = Field((0.0, 0.0, 0.0), description="rad, roll pitch yaw as in URDF")


class Overload(Section):
    """Overload limits: larger readings are invalid. None: only the sensor's own bits count."""

    force: float | None = Field(None, gt=0.0, description="N, length of the force")
    torque: float | None = Field(None, gt=0.0, description="Nm, length of the torque")


class FtSensorSettings(Section):
    """Keys that every sensor has. A zero offset belongs in the model (``ft_bias``)."""

    driver: str = Field(description="the kind of sensor")
    sensor_in_flange: SensorFrame = Field(SensorFrame(), description="how it is mounted")
    sign: Literal[1, -1] = Field(
        1, description="1: reads what the load does to it; -1: reads the reaction"
    )
    max_age: float = Field(
        0.05, gt=0.0, le=1.0, description="s without a sample after which the sensor is stale"
    )
    connect_timeout: float = Field(2.0, gt=0.0, le=60.0, description="s until the first sample")
    overload: Overload = Field(Overload(), description="what it may carry")
    when_lost: Literal["degrade", "stop"] = Field(
        "degrade",
        description="silent or overloaded: degrade goes on without force, stop ends compensating",
    )
    tcp_force: Literal["sensor", "arm"] = Field(
        "sensor", description="where actual_TCP_force comes from: this sensor, or the arm as before"
    )


class RobotousSettings(BusSettings, FtSensorSettings):
    """A Robotous RFT on CAN. Identifiers and rate are as they are set in the sensor."""

    driver: Literal["robotous_rft"]
    command_id: int = Field(0x64, ge=0, le=STANDARD_IDS, description="id that it listens to")
    reply_ids: tuple[int, int] = Field(
        (0x01, 0x02), description="ids of the first and second frame of a sample"
    )
    rate: float = Field(200.0, gt=0.0, le=1000.0, description="samples per second")
    force_counts: Number = Field(50.0, gt=0.0, description="counts per N")
    torque_counts: Number = Field(2000.0, gt=0.0, description="counts per Nm")

    @field_validator("reply_ids")
    @classmethod
    def _ids_differ(cls, value: tuple[int, int], info: ValidationInfo) -> tuple[int, int]:
        """Refuse identifiers that cannot be distinguished."""
        ids = {info.data.get("command_id"), *value}
        if len(ids) < 3 or not all(0 <= i <= STANDARD_IDS for i in value):
            raise ValueError("expected two 11-bit ids, different from each other and command_id")
        return value


class AtiSettings(BusSettings, FtSensorSettings):
    """An ATI NETCANOEM on CAN: asked sample by sample."""

    driver: Literal["ati_netcanoem"]
    base_id: int = Field(0x20, ge=0, le=0x7F, description="upper seven bits of its CAN ids")
    rate: float = Field(500.0, gt=0.0, le=1000.0, description="samples asked for per second")


class RobotiqSettings(FtSensorSettings):
    """A Robotiq FT300 on a serial line, Modbus RTU."""

    driver: Literal["robotiq_ft300"]
    port: str = Field("/dev/ttyUSB0", min_length=1, description="the serial line")
    device_id: int = Field(9, ge=1, le=247, description="Modbus address")
    baudrate: int = Field(19200, ge=1200, le=1_000_000, description="bit/s")
    mode: Literal["stream", "registers"] = Field(
        "stream", description="stream: 100 samples a second; registers: Modbus, about 50"
    )


AnyFtSensor = Annotated[
    RobotousSettings | AtiSettings | RobotiqSettings, Field(discriminator="driver")
]
"""Section ``ft_sensor``: the settings of the sensor that its ``driver`` names."""
