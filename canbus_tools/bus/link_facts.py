"""Facts of a CAN interface from Linux: read by ``ip -details -statistics -json link show``."""

import json
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from nodes.support.errors import CanductorError

_TIMEOUT_S: Final = 5.0
DRIVER_CAN, DRIVER_VCAN = "can", "vcan"


class NoInterface(CanductorError):  # noqa: N818
    """There is no such interface."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFacts:
    """An interface. None: not reported by the kernel; a vcan has no bit rate, errors or state."""

    name: str
    kind: str
    """Kind in Linux: can, vcan, vxcan; slcan and others are "can" too. Empty: not a CAN interface."""
    up: bool
    txqueuelen: int | None = None
    bitrate: int | None = None
    driver: str = ""
    """Name of the controller's timing table: gs_usb, mcp251xfd, …"""
    state: str | None = None
    """ERROR-ACTIVE, ERROR-WARNING, ERROR-PASSIVE, BUS-OFF, STOPPED."""
    restart_ms: int | None = None
    tx_errors: int | None = None
    """The controller's error counter now; 255 or more: bus-off."""
    rx_errors: int | None = None
    modes: tuple[str, ...] = ()
    """LISTEN-ONLY, ONE-SHOT, LOOPBACK, BERR-REPORTING, FD, …"""
    bus_errors: int = 0
    """This and the following: counted since the interface was created."""
    bus_offs: int = 0
    restarts: int = 0
    rx_dropped: int = 0
    """Received frames that were dropped by the kernel."""
    rx_overruns: int = 0
    """Received frames that the adapter had no room for."""


def parse_link(text: str) -> LinkFacts:
    """Read the output of ip about one interface; raises CanductorError if it is invalid."""
    try:
        links = json.loads(text)
        link = next(entry for entry in links if entry)
        return _read(link)
    except (ValueError, StopIteration, KeyError, TypeError, AttributeError) as error:
        raise CanductorError(
            f"the output of 'ip -json link show' cannot be read ({type(error).__name__}); iproute2 4.14 or "
            "newer is needed"
        ) from None


def _read(link: Mapping[str, Any]) -> LinkFacts:
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    counted = info.get("info_xstats", {})
    stats = link.get("stats64", link.get("stats", {}))
    errors = data.get("berr_counter", {})
    is_can = link.get("link_type") == "can"
    return LinkFacts(
        name=link["ifname"],
        kind=info.get("info_kind", DRIVER_CAN if is_can else "") if is_can else "",
        up="UP" in link.get("flags", ()),
        txqueuelen=link.get("txqlen"),
        bitrate=data.get("bittiming", {}).get("bitrate"),
        driver=data.get("bittiming_const", {}).get("name", ""),
        state=data.get("state"),
        # Some versions of ip omit the default, 0.
        restart_ms=data.get("restart_ms", 0) if data else None,
        tx_errors=errors.get("tx"),
        rx_errors=errors.get("rx"),
        modes=tuple(data.get("ctrlmode", ())),
        bus_errors=counted.get("bus_error", 0),
        bus_offs=counted.get("bus_off", 0),
        restarts=counted.get("restarts", 0),
        rx_dropped=stats.get("rx", {}).get("dropped", 0),
        rx_overruns=stats.get("rx", {}).get("over_errors", 0),
    )


def read_link(interface: str) -> LinkFacts:
    """Query the kernel; raises NoInterface, or CanductorError if ip is missing or does not answer."""
    words = ["ip", "-details", "-statistics", "-json", "link", "show", "dev", interface]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except FileNotFoundError:
        raise CanductorError("the command 'ip' is missing; install the package iproute2") from None
    except subprocess.TimeoutExpired:
        raise CanductorError(f"'{' '.join(words)}' does not answer") from None
    if done.returncode:
        said = " ".join(done.stderr.split())
        if "does not exist" in said or "Cannot find device" in said or "not found" in said:
            raise NoInterface(
                f"there is no interface {interface}; 'ip -details link show type can' lists CAN interfaces"
            )
        raise CanductorError(f"'{' '.join(words)}' failed: {said}")
    return parse_link(done.stdout)
