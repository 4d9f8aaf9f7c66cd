"""Authentication: tokens with scopes from a file, and a lockout for addresses that guess."""

import hashlib
import hmac
import os
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import Final

from coordinator.ipc.protocol.methods import Scope
from nodes.support.errors import CanductorError
from nodes.support.secret_file import read_secret

TOKEN_LENGTH_MIN: Final = 32
FAILURES_MAX: Final = 5
"""Failures in a row after which an address is locked out."""
LOCKOUT_S: Final = 30.0
"""For so long after the last failure; then its failures are forgotten."""
ADDRESSES_MAX: Final = 1_024
"""Addresses whose failures are remembered; the one that failed longest ago makes room."""
_SCOPES: Final = {scope.word: scope for scope in Scope}


@dataclass(frozen=True, slots=True)
class Grant:
    """What a token gives."""

    name: str
    """Empty: it has none, and callers are shown without."""
    scope: Scope


class Tokens:
    """Tokens with their scopes; ``#`` begins a comment, every other line is ``SCOPE NAME TOKEN``."""

    def __init__(self, grants: dict[str, Grant], stamp: tuple[int, ...] = ()) -> None:
        self.stamp = stamp
        """Of the file, as it was read; another one: it has changed since."""
        self._grants = {digest_of(token): grant for token, grant in grants.items()}

    @classmethod
    def read(cls, path: Path) -> "Tokens":
        """Read the file PATH; raises CanductorError when others may read it, or a line is malformed."""
        text, status = read_secret(path, "the tokens' file")
        grants: dict[str, Grant] = {}
        for number, line in enumerate(text.splitlines(), 1):
            words = line.split("#", 1)[0].split()
            if not words:
                continue
            if len(words) != 3 or words[0] not in _SCOPES:
                raise CanductorError(
                    f"{path}, line {number}: must be SCOPE NAME TOKEN, the scope one of {', '.join(_SCOPES)}"
                )
            if len(words[2]) < TOKEN_LENGTH_MIN:
                raise CanductorError(
                    f"{path}, line {number}: the token has fewer than {TOKEN_LENGTH_MIN} characters; "
                    "make one with: python3 -c 'import secrets; print(secrets.token_urlsafe())'"
                )
            if words[2] in grants:
                raise CanductorError(f"{path}, line {number}: the token occurs twice; make another one")
            grants[words[2]] = Grant(words[1], _SCOPES[words[0]])
        return cls(grants, _stamp(status))

    def check(self, token: str) -> Grant | None:
        """Return what TOKEN gives, None if nothing; takes as long whichever token it resembles."""
        return self.grant_of(digest_of(token))

    def grant_of(self, digest: bytes) -> Grant | None:
        """Return what the token with DIGEST gives, None if nothing; takes as long whichever it is."""
        found: Grant | None = None
        for known, grant in self._grants.items():
            if hmac.compare_digest(known, digest):
                found = grant
        return found


def digest_of(secret: str) -> bytes:
    """Return what stands for SECRET where it is only compared with: SHA-256."""
    return hashlib.sha256(secret.encode(errors="replace")).digest()


def stamp_of(path: Path) -> tuple[int, ...]:
    """Return what changes when the file PATH does; nothing when there is none."""
    try:
        return _stamp(path.stat())
    except OSError:
        return ()


def _stamp(status: os.stat_result) -> tuple[int, ...]:
    return (status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size)


class LoginThrottle:
    """Locks an address out that failed too often; sans-IO, times in seconds of one clock."""

    def __init__(self) -> None:
        self._failures: dict[str, tuple[int, float]] = {}  # the latest at the end

    def failed(self, address: str, now_s: float) -> None:
        """Note that ADDRESS gave a wrong token."""
        network = _network(address)
        count, last_s = self._failures.pop(network, (0, now_s))
        if now_s - last_s > LOCKOUT_S:
            count = 0
        if len(self._failures) >= ADDRESSES_MAX:
            del self._failures[next(iter(self._failures))]
        self._failures[network] = (count + 1, now_s)

    def lockout_s(self, address: str, now_s: float) -> float:
        """Return for how long ADDRESS has to wait, 0 if it may connect."""
        count, last_s = self._failures.get(_network(address), (0, 0.0))
        return max(0.0, last_s + LOCKOUT_S - now_s) if count >= FAILURES_MAX else 0.0


def _network(address: str) -> str:
    """Return what stands for ADDRESS: who has one IPv6 address has the other 2^64 of its network."""
    try:
        ip = ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(ip, IPv6Address) and ip.ipv4_mapped is None:
        return ip.exploded[:19]
    return str(ip.ipv4_mapped if isinstance(ip, IPv6Address) else ip)
