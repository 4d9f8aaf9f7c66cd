"""Why nobody could be reached at an address, or let nobody in, and what to do about it."""

import ssl
from dataclasses import replace
from typing import Final

from coordinator.ipc.protocol.address import Address
from coordinator.ipc.protocol.methods import ApiError

_OF_OTHER_NAME: Final = (62, 64)
"""X509_V_ERR_HOSTNAME_MISMATCH and X509_V_ERR_IP_ADDRESS_MISMATCH."""
_OF_OTHER_TIME: Final = (9, 10)
"""X509_V_ERR_CERT_NOT_YET_VALID and X509_V_ERR_CERT_HAS_EXPIRED."""

_NO_TLS: Final = ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG")
"""What OpenSSL, by its version, says of a first answer that is no TLS."""


def why_no_answer(address: Address, error: OSError) -> str:
    """Return a sentence on ERROR, with which connecting to ADDRESS failed."""
    if isinstance(error, ssl.SSLError):
        return _why_no_tls(address, error)
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


def _why_no_tls(address: Address, error: ssl.SSLError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        told = error.verify_message.rstrip(".")
        if error.verify_code in _OF_OTHER_NAME:
            advice = "call it by a name that is in its certificate"
        elif error.verify_code in _OF_OTHER_TIME:
            advice = "check the clocks of both computers, and make a new one if they are right"
        else:
            advice = "name the one that it must have with --certificate PEM"
        return f"the certificate of {address} cannot be trusted: {told}; {advice}"
    if error.reason in _NO_TLS:
        return f"{address} does not speak TLS; a port without TLS is named {replace(address, tls=False)}"
    return (
        f"there is no TLS connection with {address}: {(error.reason or str(error)).replace('_', ' ').lower()}"
    )


def doubt(address: Address) -> str:
    """Return what to add to a sentence on a server that ended the connection to ADDRESS without a word."""
    if address.path is not None or address.tls:
        return ""
    return f" before it said a word; a port with TLS is named {replace(address, tls=True)}"


def why_refused(address: Address, fault: ApiError) -> str:
    """Return what FAULT, with which the server at ADDRESS ended the connection, means to whoever called."""
    if fault.code == "no_token":
        return f"{address} wants a token; name the file that holds it with --token-file (programs: token)"
    return fault.sentence
