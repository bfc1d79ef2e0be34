"""Section ``metrics`` of a cell: the page that Prometheus reads."""

from __future__ import annotations

from pydantic import Field

from gapbridge.bridge.served.settings import ServedSettings

METRICS_PORT = 30390


class MetricsSettings(ServedSettings):
    """Prometheus metrics; a cell without this section has none."""

    port: int = Field(METRICS_PORT, ge=0, le=65535, description="TCP port; 0: any that is free")
