"""Sentences on failed connections: why, and what to do about it."""

import ssl
from dataclasses import replace
from typing import Final

from coordinator.ipc.protocol.address import Address
from coordinator.ipc.protocol.methods import ApiError

_NAME_MISMATCH: Final = (62, 64)
"""X509_V_ERR_HOSTNAME_MISMATCH and X509_V_ERR_IP_ADDRESS_MISMATCH."""
_TIME_MISMATCH: Final = (9, 10)
"""X509_V_ERR_CERT_NOT_YET_VALID and X509_V_ERR_CERT_HAS_EXPIRED."""

_NO_TLS: Final = ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG")
"""What OpenSSL, by its version, says of a first answer that is no TLS."""


def connect_error_sentence(address: Address, error: OSError | ValueError) -> str:
    """Return a sentence on ERROR, with which connecting to ADDRESS failed."""
    if not isinstance(error, OSError):  # an empty label, one of more than 63 characters, NUL
        return f"{address} does not answer: nothing can have this name; correct it"
    if isinstance(error, ssl.SSLError):
        return _tls_error_sentence(address, error)
    if not isinstance(error, ConnectionRefusedError):
        return f"{address} does not answer: {error.strerror or error}"
    if address.path is None:
        return f"{address} does not answer: no program listens at this port"
    if not address.path.is_socket():
        kind = "folder" if address.path.is_dir() else "file"
        return f"{address} is a {kind}, not a socket; canductor discover lists the machines here"
    return (
        f"{address} does not answer: a coordinator that ended left this socket; start one with canductor run"
    )


def _tls_error_sentence(address: Address, error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        reason = error.verify_message.rstrip(".")
        if error.verify_code in _NAME_MISMATCH:
            advice = "use a name that is in its certificate"
        elif error.verify_code in _TIME_MISMATCH:
            advice = "check the clocks of both computers, and renew the certificate if they are right"
        else:
            advice = "give the certificate that it must have with --certificate PEM"
        return f"the certificate of {address} cannot be trusted: {reason}; {advice}"
    if error.reason in _NO_TLS:
        return f"{address} does not use TLS; without TLS its address is {replace(address, tls=False)}"
    return (
        f"there is no TLS connection with {address}: {(error.reason or str(error)).replace('_', ' ').lower()}"
    )


def tls_hint(address: Address) -> str:
    """Return an addition for a server that closed the connection to ADDRESS without a message."""
    if address.path is not None or address.tls:
        return ""
    return f" before it sent anything; with TLS its address is {replace(address, tls=True)}"


def refusal_sentence(address: Address, fault: ApiError) -> str:
    """Return a sentence on FAULT, with which the server at ADDRESS ended the connection."""
    if fault.code == "no_token":
        return f"{address} needs a token; give the file that holds it with --token-file (programs: token)"
    return fault.sentence
