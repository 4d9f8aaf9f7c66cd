"""This computer's networks, and multicast DNS on them."""

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
"""Addresses of this computer that multicast DNS uses; it opens a socket for each."""


@dataclass(frozen=True, slots=True)
class InterfaceAddress:
    """An address of this computer, and the number of the interface that has it."""

    address: IPv4Address | IPv6Address
    interface: int


def interface_addresses() -> tuple[InterfaceAddress, ...]:
    """Return all of this computer's addresses that mean something beyond one link."""
    found = []
    for adapter in ifaddr.get_adapters():
        for ip in adapter.ips:
            address = ip_address(ip.ip if isinstance(ip.ip, str) else ip.ip[0])
            if not (isinstance(address, IPv6Address) and address.is_link_local):
                found.append(InterfaceAddress(address, adapter.index or 0))
    found.sort(key=lambda each: (each.address.version, int(each.address)))
    return tuple(found[:INTERFACE_ADDRESSES_MAX])


def reachable_addresses(
    bound: Iterable[str], here: Iterable[InterfaceAddress]
) -> tuple[InterfaceAddress, ...]:
    """Return the addresses HERE through which sockets BOUND to these addresses are reached.

    A socket for all addresses is reached through each of its IP version but the loopback.
    """
    wanted = [ip_address(text.partition("%")[0]) for text in bound]
    return tuple(
        each
        for each in here
        if any(
            (ip.is_unspecified and ip.version == each.address.version and not each.address.is_loopback)
            or ip == each.address
            for ip in wanted
        )
    )


def mdns_addresses(
    reachable: Iterable[InterfaceAddress], here: Iterable[InterfaceAddress]
) -> tuple[str, ...]:
    """Return the addresses on which to announce what is REACHABLE: all those of the same interfaces."""
    interfaces = {each.interface for each in reachable}
    return tuple(str(each.address) for each in here if each.interface in interfaces)


def open_mdns(addresses: Iterable[str]) -> AsyncZeroconf:
    """Return multicast DNS on the interfaces that have ADDRESSES; raises CanductorError."""
    logging.getLogger("zeroconf").setLevel(logging.CRITICAL)  # what strangers send is not logged
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
