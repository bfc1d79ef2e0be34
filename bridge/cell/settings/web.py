"""Sections ``web`` and ``metrics`` of a cell: the status page and Prometheus metrics."""

from __future__ import annotations

from pydantic import Field

from gapbridge.bridge.served.settings import ServedSettings

METRICS_PORT = 30390
WEB_PORT = 30380


class MetricsSettings(ServedSettings):
    """Prometheus metrics; a cell without this section has none."""

    port: int = Field(METRICS_PORT, ge=1, le=65535, description="TCP port")


class WebSettings(ServedSettings):
    """The status page; a cell without this section has none."""

    port: int = Field(WEB_PORT, ge=1, le=65535, description="TCP port")
    clients: int = Field(
        16, ge=1, le=1000, description="largest number of pages open at the same time"
    )
    history: float = Field(600.0, gt=0.0, le=86400.0, description="s of offsets and wrenches shown")
