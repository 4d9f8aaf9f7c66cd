"""This computer's networks, and multicast DNS on them.

zeroconf is imported when it is used: no other command shall pay for it.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

import ifaddr
from zeroconf import Error, IPVersion
from zeroconf.asyncio import AsyncZeroconf

from nodes.support.errors import CanductorError

INTERFACE_ADDRESSES_MAX: Final = 64
"""Addresses of this computer on which multicast DNS is spoken; it has a socket for each."""


@dataclass(frozen=True, slots=True)
class Place:
    """An address of this computer, and the number of the interface that has it."""

    address: IPv4Address | IPv6Address
    interface: int


def places() -> tuple[Place, ...]:
    """Return all of this computer's addresses that mean something beyond one link."""
    found = []
    for adapter in ifaddr.get_adapters():
        for ip in adapter.ips:
            address = ip_address(ip.ip if isinstance(ip.ip, str) else ip.ip[0])
            if not (isinstance(address, IPv6Address) and address.is_link_local):
                found.append(Place(address, adapter.index or 0))
    found.sort(key=lambda place: (place.address.version, int(place.address)))
    return tuple(found[:INTERFACE_ADDRESSES_MAX])


def reached_at(bound: Iterable[str], here: Iterable[Place]) -> tuple[Place, ...]:
    """Return the places HERE through which sockets BOUND to these addresses are reached.

    A socket for all addresses is reached through each of its family but the loopback.
    """
    wanted = [ip_address(text.partition("%")[0]) for text in bound]
    return tuple(
        place
        for place in here
        if any(
            (ip.is_unspecified and ip.version == place.address.version and not place.address.is_loopback)
            or ip == place.address
            for ip in wanted
        )
    )


def spoken_on(reached: Iterable[Place], here: Iterable[Place]) -> tuple[str, ...]:
    """Return the addresses on which to speak of REACHED: all those of the same interfaces."""
    interfaces = {place.interface for place in reached}
    return tuple(str(place.address) for place in here if place.interface in interfaces)


def open_mdns(addresses: Iterable[str]) -> "AsyncZeroconf":
    """Return multicast DNS on the interfaces that have ADDRESSES; raises CanductorError."""
    logging.getLogger("zeroconf").setLevel(logging.CRITICAL)  # strangers' garbage is no news
    chosen = list(addresses)
    if not chosen:
        raise CanductorError("this computer has no network address; connect it, or look at 'ip address'")
    versions = IPVersion.All if any(":" in address for address in chosen) else IPVersion.V4Only
    try:
        return AsyncZeroconf(interfaces=[*chosen], ip_version=versions)
    except OSError as error:
        raise CanductorError(
            f"multicast DNS (UDP port 5353) cannot be used: {error.strerror or error}; a program that keeps "
            "the port to itself, or a firewall, may be the reason"
        ) from None
    except (Error, RuntimeError, ValueError) as error:  # an interface went away in between
        raise CanductorError(f"multicast DNS cannot be used: {error or type(error).__name__}") from None
