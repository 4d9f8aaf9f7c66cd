"""Imports asyncio and hashlib as on a Python without OpenSSL, which takes 5 MB of each process that loads it.

A service has TLS of its own (coordinator/ipc/server/tls_transport.py), and most have none. Both libraries do
without OpenSSL where Python was built without it: asyncio's streams have no TLS then, hashlib calculates with
Python's own code. ``import ssl`` works as ever afterwards.
"""

import sys
from importlib import import_module
from typing import Final

_OPENSSL: Final = ("ssl", "_hashlib")
_IMPORTED: Final = ("asyncio", "hashlib", "hmac")
_NEEDED: Final = "sha256"
"""Of hashlib; some builds of Python have it from OpenSSL alone."""


def import_without_openssl() -> None:
    """Import them so, once for the process; without effect when any of them was imported before."""
    if not sys.modules.keys().isdisjoint((*_OPENSSL, *_IMPORTED)):
        return
    modules: dict[str, object] = sys.modules  # type: ignore[assignment]
    modules |= dict.fromkeys(_OPENSSL)
    try:
        for name in _IMPORTED:
            import_module(name)
    finally:
        for name in _OPENSSL:
            del sys.modules[name]
    if not hasattr(sys.modules["hashlib"], _NEEDED):
        for name in _IMPORTED[1:]:
            del sys.modules[name]
