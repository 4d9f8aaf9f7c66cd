"""The announcement of a machine on the network: one DNS-SD service of type ``_canductor._tcp``.

docs/ipc.md describes its TXT record. Any computer on the network can send any record, so reading never
raises: it returns an announcement, or None.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from typing import Final, Self

SERVICE_TYPE: Final = "_canductor._tcp.local."
ADDRESSES_MAX: Final = 8
"""Addresses of one machine; further ones are left out."""
_WORDS: Final = {
    "name": re.compile(r"[A-Za-z0-9_-]{1,48}"),
    "host": re.compile(r"[!-~]{1,64}"),
    "version": re.compile(r"[ -~]{1,48}"),
    "state": re.compile(r"[a-z][a-z_]{0,23}"),
    "api": re.compile(r"[1-9][0-9]{0,2}"),
    "tls": re.compile(r"[01]"),
    "id": re.compile(r"[0-9a-f]{16}"),
    "change": re.compile(r"[0-9]{1,12}"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Announcement:
    """One machine and its addresses."""

    name: str
    host: str
    """Host name of the computer it runs on."""
    version: str
    state: str
    api: int
    """Version of the interface (docs/ipc.md)."""
    tls: bool
    id: str
    """Identifies one run of a coordinator: addresses with the same id lead to the same one."""
    port: int
    addresses: tuple[str, ...]
    """IP addresses, IPv4 first."""
    change: int = 0
    """Incremented with each change: some resolvers keep an old record for seconds."""

    def txt(self) -> dict[str, str]:
        """Return the TXT record."""
        words = {name: getattr(self, name) for name in _WORDS}
        return {name: str(int(word) if isinstance(word, bool) else word) for name, word in words.items()}

    @classmethod
    def read(
        cls, txt: Mapping[bytes, bytes | None], port: int | None, addresses: Iterable[str]
    ) -> Self | None:
        """Return what a service record and its TXT say; None when it is not a machine that can be reached."""
        words = {key: (txt.get(key.encode()) or b"").decode("ascii", "replace") for key in _WORDS}
        if any(rule.fullmatch(words[key]) is None for key, rule in _WORDS.items()):
            return None
        usable = usable_addresses(addresses)
        if words["tls"] == "0":  # no machine serves plain TCP beyond loopback: tokens could be read
            usable = tuple(address for address in usable if ip_address(address).is_loopback)
        if port is None or not 0 < port < 65536 or not usable:
            return None
        return cls(
            **{key: words[key] for key in ("name", "host", "version", "state", "id")},
            api=int(words["api"]),
            tls=words["tls"] == "1",
            change=int(words["change"]),
            port=port,
            addresses=usable,
        )

    @property
    def at(self) -> tuple[str, ...]:
        """Values for ``--at``, the best first."""
        scheme = "tls" if self.tls else "tcp"
        return tuple(f"{scheme}://{bracketed(address)}:{self.port}" for address in self.addresses)


def usable_addresses(addresses: Iterable[str]) -> tuple[str, ...]:
    """Return the addresses that can be connected to, IPv4 first; without link-local ones."""
    usable = set()
    for text in addresses:
        try:
            address = ip_address(text)
        except ValueError:
            continue
        if address.is_unspecified or address.is_multicast:
            continue
        if isinstance(address, IPv6Address) and (address.is_link_local or address.scope_id):
            continue
        usable.add(address)
    ordered = sorted(usable, key=lambda address: (address.version, int(address)))
    return tuple(map(str, ordered[:ADDRESSES_MAX]))


def bracketed(address: str) -> str:
    """Return ADDRESS in the form that is used before a port."""
    return f"[{address}]" if ":" in address else address


def host_word(host: str) -> str:
    """Return the host name with the characters that an announcement can carry."""
    return re.sub(r"[^!-~]", "_", host)[:64] or "unknown"
