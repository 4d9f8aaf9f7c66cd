"""What a machine announces of itself on the network: one DNS-SD service of type ``_canductor._tcp``.

docs/ipc.md describes its TXT record. Everybody on the network can send anything, so reading is total: an
announcement, or None.
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
    """One machine and where it is reached."""

    name: str
    host: str
    """The name that the computer it runs on has for itself."""
    version: str
    state: str
    api: int
    """Version of the interface (docs/ipc.md)."""
    tls: bool
    id: str
    """Identifies one run of a coordinator: two addresses with the same id lead to the same one."""
    port: int
    addresses: tuple[str, ...]
    """IP addresses, IPv4 first."""
    change: int = 0
    """Rises with each change: some keep an old record for seconds, and miss a state that comes back to it."""

    def txt(self) -> dict[str, str]:
        """Return the TXT record."""
        return {
            "name": self.name,
            "host": self.host,
            "version": self.version,
            "state": self.state,
            "api": str(self.api),
            "tls": "1" if self.tls else "0",
            "id": self.id,
            "change": str(self.change),
        }

    @classmethod
    def read(
        cls, txt: Mapping[bytes, bytes | None], port: int | None, addresses: Iterable[str]
    ) -> Self | None:
        """Return what a service record and its TXT say; None when it is not a machine that can be reached."""
        words: dict[str, str] = {}
        for key, rule in _WORDS.items():
            word = (txt.get(key.encode()) or b"").decode("ascii", "replace")
            if rule.fullmatch(word) is None:
                return None
            words[key] = word
        usable = usable_addresses(addresses)
        if words["tls"] == "0":  # no machine has such a port beyond its loopback: a token would be read there
            usable = tuple(address for address in usable if ip_address(address).is_loopback)
        if port is None or not 0 < port < 65536 or not usable:
            return None
        return cls(
            name=words["name"],
            host=words["host"],
            version=words["version"],
            state=words["state"],
            api=int(words["api"]),
            tls=words["tls"] == "1",
            id=words["id"],
            change=int(words["change"]),
            port=port,
            addresses=usable,
        )

    @property
    def at(self) -> tuple[str, ...]:
        """What to give to ``--at``, the best first."""
        scheme = "tls" if self.tls else "tcp"
        return tuple(f"{scheme}://{bracketed(address)}:{self.port}" for address in self.addresses)


def usable_addresses(addresses: Iterable[str]) -> tuple[str, ...]:
    """Return those that one can connect to, IPv4 first; not those that mean something on one link only."""
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
    """Return ADDRESS as it stands before a port."""
    return f"[{address}]" if ":" in address else address


def host_word(host: str) -> str:
    """Return the name of a computer as an announcement can carry it."""
    return re.sub(r"[^!-~]", "_", host)[:64] or "unknown"
