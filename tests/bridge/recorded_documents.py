"""The JSON messages of a recording."""

from __future__ import annotations

from pathlib import Path

from gapbridge.core.log.mcap_reading import Document, read_batches
from gapbridge.core.log.mcap_schema import EVENTS


def read_documents(path: Path, channel: str = EVENTS) -> list[Document]:
    """Return all JSON messages of a channel, in order."""
    return [
        document
        for batch in read_batches(path)
        for topic, document in batch.documents
        if topic == channel
    ]
