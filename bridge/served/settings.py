"""The keys that every served section of a cell shares (``web``, ``metrics``)."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Self

from pydantic import Field, field_validator, model_validator

from gapbridge.drivers.section import Section

GUARDS = ("certificate", "key", "token_file")


class ServedSettings(Section):
    """Address and credentials of a server; beyond loopback it needs TLS and a token."""

    host: str = Field("127.0.0.1", description="an address of this machine, or localhost")
    port: int = Field(0, ge=0, le=65535, description="TCP port")
    certificate: Path | None = Field(None, description="TLS: certificate chain, PEM")
    key: Path | None = Field(None, description="TLS: private key, PEM")
    token_file: Path | None = Field(
        None, description="a file that only its owner reads (mode 0600), with the token"
    )
    names: tuple[str, ...] = Field(
        (), description="host names that it may be asked by, beside addresses and localhost"
    )

    @property
    def is_local(self) -> bool:
        """Return whether only this machine can reach it."""
        return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback

    @property
    def url(self) -> str:
        """Return its URL."""
        scheme = "http" if self.certificate is None else "https"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{scheme}://{host}:{self.port}/"

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        """Refuse names: their addresses may change after the check."""
        if value != "localhost":
            try:
                ipaddress.ip_address(value)
            except ValueError:
                raise ValueError(
                    "expected an address (127.0.0.1, ::1, 192.168.0.10, ...)"
                ) from None
        return value

    @field_validator("names")
    @classmethod
    def _plain_names(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        """Return names in lower case."""
        return tuple(name.lower().rstrip(".") for name in value)

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        """Refuse to serve others without TLS and a token."""
        if (self.certificate is None) != (self.key is None):
            raise ValueError("expected certificate and key together")
        missing = [name for name in GUARDS if getattr(self, name) is None]
        if missing and not self.is_local:
            raise ValueError(
                f"expected a loopback host (127.0.0.1), or TLS and a token for {self.host}: "
                f"{', '.join(missing)} left out"
            )
        return self

    def located(self, folder: Path) -> Self:
        """Return the settings with paths made absolute, without links in them."""
        return super().located(folder.resolve())
