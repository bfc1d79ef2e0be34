"""TLS to one controller: who answers must be the one that the cell names, before any request."""

from __future__ import annotations

import hashlib
import ssl
from typing import Any

from gapbridge.core.errors import InputError
from gapbridge.drivers.modbus.settings import ModbusSettings


class CheckedContext(ssl.SSLContext):
    """A context whose sockets know whom they are to reach.

    The Modbus library hands no name to ``wrap_socket``, and connects again by itself; so the name
    is handed on here, and a pinned certificate is compared at the end of every handshake.
    """

    server_name: str
    pinned: bytes | None = None  # SHA-256 of the controller's certificate
    refused = ""  # why the last handshake failed: the library keeps it to itself

    def note_refusal(self, detail: str) -> None:
        """Keep why the last handshake failed; empty: it did not."""
        self.refused = detail

    def wrap_socket(self, *arguments: Any, **keys: Any) -> ssl.SSLSocket:
        """Return a TLS socket that checks its peer as it connects."""
        keys["server_hostname"] = self.server_name
        return super().wrap_socket(*arguments, **keys)


class _CheckedSocket(ssl.SSLSocket):
    """A socket that compares the peer's certificate with the pinned one."""

    def do_handshake(self, block: bool = False) -> None:
        """Shake hands. Raises SSLError where the certificate is another than the pinned one."""
        context = self.context
        assert isinstance(context, CheckedContext)
        context.note_refusal("")
        try:
            super().do_handshake(block)
        except ssl.SSLCertVerificationError as error:
            context.note_refusal(f"its certificate is refused: {error.verify_message}")
            raise
        if context.pinned is None:
            return
        found = hashlib.sha256(self.getpeercert(binary_form=True) or b"").digest()
        if found != context.pinned:
            detail = (
                f"found a certificate with SHA-256 {found.hex()}, expected {context.pinned.hex()} "
                "(link.fingerprint)"
            )
            context.note_refusal(detail)
            raise ssl.SSLError(1, detail)


def checked_context(settings: ModbusSettings) -> ssl.SSLContext:
    """Return a context that lets only the cell's controller in.

    With ``authority`` the certificate must come from there and be made out to ``host``; with
    ``fingerprint`` it must be that very one, whatever name it has. Raises InputError where a file
    cannot be used.
    """
    context = CheckedContext(ssl.PROTOCOL_TLS_CLIENT)
    context.sslsocket_class = _CheckedSocket
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.server_name = settings.host
    if settings.fingerprint is not None:
        context.pinned = bytes.fromhex(settings.fingerprint)
    context.check_hostname = context.pinned is None
    context.verify_mode = ssl.CERT_NONE if settings.authority is None else ssl.CERT_REQUIRED
    try:
        if settings.authority is not None:
            context.load_verify_locations(settings.authority)
        if settings.certificate is not None:
            context.load_cert_chain(settings.certificate, settings.key)
    except OSError as error:
        raise InputError(
            f"link: authority, certificate, key: {error.strerror or error}, expected PEM files "
            "that can be read"
        ) from None
    return context
