"""The status page's process: ``python -m gapbridge.bridge.web.main``, started by the daemon.

It reads along - the shared page through a descriptor that cannot be written to - and answers
browsers. It has no way to the robot and none to arm anything.
"""

from __future__ import annotations

import sys

from gapbridge.bridge.ipc.side_main import Order, run_side
from gapbridge.bridge.served.credentials import read_token
from gapbridge.bridge.served.server import serve
from gapbridge.bridge.web.app import make_app
from gapbridge.bridge.web.stream import Stream
from gapbridge.bridge.web.watched import Watched, encoded

TURN = 0.1  # s between two looks at the shared page


def run(order: Order) -> None:
    """Serve the page until the daemon is gone. Raises LinkError, InputError."""
    settings = order.settings.web
    assert settings is not None
    path = settings.token_file
    token = None if path is None else read_token(path, "web.token_file")
    watched = Watched(order.settings, order.n, order.session, order.page, order.extra.get("text"))
    stream = Stream(settings.clients)

    def turn() -> None:
        for kind, data in watched.turn(order.events.poll()):
            if stream.is_watched:
                stream.publish(kind, encoded(data))

    def over() -> bool:
        if order.events.closed:
            stream.close()
        return order.events.closed

    serve(make_app(watched, stream, settings, token), settings, "web", over, turn, TURN)


if __name__ == "__main__":
    sys.exit(run_side("web", run))
