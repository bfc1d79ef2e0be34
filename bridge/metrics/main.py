"""The metrics' process: ``python -m gapbridge.bridge.metrics.main``, started by the daemon.

It reads along as the status page does, and answers Prometheus at /metrics.
"""

from __future__ import annotations

import sys

from prometheus_client import CollectorRegistry, generate_latest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from gapbridge.bridge.ipc.side_main import Order, run_side
from gapbridge.bridge.metrics.counts import Counts
from gapbridge.bridge.metrics.families import Families
from gapbridge.bridge.served.credentials import read_token
from gapbridge.bridge.served.guard import Guard
from gapbridge.bridge.served.server import serve

TURN = 0.25  # s between two looks at the shared page
TEXT = "text/plain; version=0.0.4; charset=utf-8"


def run(order: Order) -> None:
    """Serve metrics until the daemon is gone. Raises LinkError, InputError."""
    settings = order.settings.metrics
    assert settings is not None
    path = settings.token_file
    token = None if path is None else read_token(path, "metrics.token_file")
    counts = Counts(order.page, order.settings, order.extra.get("text"))
    registry = CollectorRegistry(auto_describe=False)

    async def metrics(request: Request) -> Response:
        counts.turn(order.events.poll())
        return Response(generate_latest(registry), media_type=TEXT)

    guard = Guard(Starlette(routes=[Route("/metrics", metrics)]), settings, token)
    registry.register(Families(order.session, counts, guard.refused))
    serve(
        guard, settings, "metrics", lambda: order.events.closed,
        lambda: counts.turn(order.events.poll()), TURN,
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(run_side("metrics", run))
