"""The link to a Modbus controller: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from gapbridge.drivers.link_settings import ProfileSettings
from gapbridge.drivers.section import PlainHost


class ModbusSettings(ProfileSettings):
    """How to reach a Modbus controller, and which register map it has.

    ``profile`` is the name of a shipped one (``ur``, ``igus``, ...) or a path ending in .yaml,
    relative to the cell's folder.
    """

    shipped = Path(__file__).with_name("profiles")
    driver: Literal["modbus"] = "modbus"
    transport: Literal["tcp", "tls", "rtu"] = "tcp"
    host: PlainHost = Field("127.0.0.2", min_length=1, description="tcp, tls: address or name")
    port: int | None = Field(
        None, gt=0, lt=65536, description="tcp, tls: port; left out: the profile's"
    )
    device_id: int | None = Field(
        None, ge=0, le=255, description="unit id; left out: the profile's"
    )
    serial: str | None = Field(None, description="rtu: the serial port, as /dev/ttyUSB0")
    baudrate: int = Field(19200, ge=1200, le=4000000, description="rtu: bit/s")
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    authority: Path | None = Field(None, description="tls: PEM of the CA that is trusted")
    fingerprint: str | None = Field(
        None,
        description="tls: SHA-256 of the controller's own certificate, 64 hexadecimal digits; then "
        "its name is not compared with host",
    )
    certificate: Path | None = Field(None, description="tls: PEM of our own certificate")
    key: Path | None = Field(None, description="tls: PEM of our own key")
    rate: float = Field(20.0, gt=0.0, le=500.0, description="cycles per second asked for")
    state_timeout: float = Field(
        0.5, gt=0.0, le=5.0, description="s without a new sample after which the state is stale"
    )
    timeout: float = Field(0.1, gt=0.0, le=2.0, description="s that one answer may take")
    coarsest: float | None = Field(
        None, gt=0.0,
        description="m that one count of a target register may move the TCP; left out: the "
        "offset that the model predicts where the arm stands",
    )  # fmt: skip

    @model_validator(mode="after")
    def _has_its_transport(self) -> Self:
        """Refuse a transport without its required keys."""
        if self.transport == "rtu" and self.serial is None:
            raise ValueError("expected serial, the port to open, with transport rtu")
        if self.transport == "tls" and self.authority is None and self.fingerprint is None:
            raise ValueError(
                "expected authority, the CA that is trusted, or fingerprint, the controller's own "
                "certificate, with transport tls"
            )
        return self

    @field_validator("fingerprint")
    @classmethod
    def _plain_fingerprint(cls, value: str | None) -> str | None:
        """Take a SHA-256 as tools print it, with colons or without."""
        if value is None:
            return None
        digits = value.replace(":", "").lower()
        if len(digits) != 64 or not set(digits) <= set("0123456789abcdef"):
            raise ValueError("expected 64 hexadecimal digits, the SHA-256 of a certificate")
        return digits

    @property
    def moves_arm(self) -> bool:
        """Return whether setpoints are the arm's motion. Raises InputError: it reads the profile.

        With a mailbox they are offsets on the robot's own motion.
        """
        from gapbridge.drivers.modbus.profile import read_profile

        return read_profile(self.profile_path).write.mode != "mailbox"

    @property
    def largest_offset(self) -> tuple[float, float]:
        """Return what a mailbox's 16 bits hold, m and rad. Raises InputError: see moves_arm."""
        from gapbridge.drivers.modbus.encode import LARGEST
        from gapbridge.drivers.modbus.profile import read_profile

        write = read_profile(self.profile_path).write
        if write.mode != "mailbox":
            return super().largest_offset
        return LARGEST * write.length_count, LARGEST * write.angle_count

    def read_files(self) -> None:
        """Read the profile; see DriverSettings."""
        from gapbridge.drivers.modbus.profile import read_profile

        read_profile(self.profile_path)
