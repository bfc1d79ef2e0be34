"""The credential files of a server: token, certificate and key, checked before a run."""

from __future__ import annotations

import ssl
import stat
from pathlib import Path

from gapbridge.bridge.served.settings import ServedSettings
from gapbridge.core.errors import CellError, Keys
from gapbridge.core.files import is_given, read_bytes

SHORTEST_TOKEN = 32  # characters: too long to be guessed
LONGEST_TOKEN = 1024
SETPOINT_TOKEN = ("setpoints", "token_file")  # keys of the cell: a planner's over TCP


def check_credentials(settings: ServedSettings, section: str) -> None:
    """Raise CellError where a file cannot be used; ``section`` names the cell's section."""
    if settings.token_file is not None:
        read_token(settings.token_file, (section, "token_file"))
    tls_context(settings, section)


def read_token(path: Path, keys: Keys) -> str:
    """Return the token in a file. Raises CellError where it is readable to others, or too short.

    ``keys`` are those of the cell that name the file; the token itself is in no message.
    """
    try:
        mode = 0o600 if is_given() else path.stat().st_mode  # else the daemon has checked
        content = read_bytes(path)[: LONGEST_TOKEN + 2]
    except OSError as error:
        raise CellError(f"{path}: {error.strerror}, expected a file with a token", keys) from None
    if stat.S_IMODE(mode) & 0o077:
        raise CellError(
            f"{path}: found mode {stat.S_IMODE(mode):04o}, expected 0600: a file that only its "
            "owner reads",
            keys,
        )
    token = content.decode("ascii", "replace").strip()
    if not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN or not token.isprintable() or (
        not token.isascii() or " " in token
    ):  # fmt: skip
        raise CellError(
            f"{path}: found {len(token)} characters, expected {SHORTEST_TOKEN} to {LONGEST_TOKEN} "
            "letters, digits and signs in one line (openssl rand -hex 32)",
            keys,
        )
    return token


def tls_context(settings: ServedSettings, section: str) -> ssl.SSLContext | None:
    """Return the server's TLS, None without a certificate. Raises CellError."""
    if settings.certificate is None or settings.key is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    for path, name in ((settings.certificate, "certificate"), (settings.key, "key")):
        if not path.is_file():
            raise CellError(f"{path}: found no file, expected PEM", (section, name))
    try:
        # a password would be asked for on the terminal: the key must have none
        context.load_cert_chain(settings.certificate, settings.key, password=lambda: b"")
    except (ssl.SSLError, OSError, ValueError) as error:
        message = getattr(error, "reason", None) or getattr(error, "strerror", None) or str(error)
        raise CellError(
            f"{settings.certificate}: cannot be used with {settings.key}: {message}, expected PEM "
            "of one pair without a password",
            (section, "certificate"),
        ) from None
    return context
