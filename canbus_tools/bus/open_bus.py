"""Opening the CAN bus that a tool works on, with the options python-can's own tools have."""

import argparse
from dataclasses import dataclass
from typing import Any

import can

from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, integer

BITRATE_MIN, BITRATE_MAX = 10_000, 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOptions:
    """Which bus."""

    interface: str = "socketcan"
    """A backend of python-can; ``canductor``: the project's virtual bus, CHANNEL is its socket."""
    channel: str = "can0"
    bitrate: int | None = None
    """Bit/s; None: as the interface is set."""
    listen_only: bool = False
    """Never disturb the bus, not even by an acknowledgement; only some adapters can."""

    @property
    def short_name(self) -> str:
        """How a bus is called in recordings and lines: of a path, the last part."""
        return self.channel.rpartition("/")[2] or self.channel

    @property
    def name(self) -> str:
        """How messages call the bus."""
        return self.channel if self.interface == "socketcan" else f"{self.interface}:{self.channel}"


def declare_bus(command: argparse.ArgumentParser) -> None:
    """Add the options that say which bus."""
    add = command.add_argument
    add("-i", "--interface", default="socketcan", help="backend of python-can (default: %(default)s)")
    add("-c", "--channel", help="channel of the backend (default: can0)")
    add(
        "-b",
        "--bitrate",
        type=integer(BITRATE_MIN, BITRATE_MAX),
        metavar="BIT/S",
        help="set the adapter to this bit rate, if the backend can",
    )


def bus_options(given: argparse.Namespace) -> BusOptions:
    """Return what ``declare_bus`` declared; raises UsageError."""
    if given.channel is None and given.interface != "socketcan":
        raise UsageError(f"--channel is missing: python-can's backend '{given.interface}' requires it")
    return BusOptions(interface=given.interface, channel=given.channel or "can0", bitrate=given.bitrate)


def open_bus(options: BusOptions) -> can.BusABC:
    """Open the bus; raises CanductorError with what failed and what to do."""
    extra: dict[str, Any] = {} if options.bitrate is None else {"bitrate": options.bitrate}
    if options.listen_only and options.interface not in ("socketcan", "canductor"):
        extra["listen_only"] = True
    try:
        return can.Bus(channel=options.channel, interface=options.interface, **extra)
    # Backends raise what their vendors' libraries raise: there is no common type to name.
    except Exception as error:
        raise CanductorError(f"CAN bus {options.name}: {_why(options, error)}") from error


def _why(options: BusOptions, error: Exception) -> str:
    said = " ".join(str(error).split()) or type(error).__name__
    if options.interface == "canductor":
        return said.partition(": ")[2] or said  # it names the bus, as the sentence does already
    if options.interface == "socketcan":
        if "No such device" in said:
            return (
                f"there is no such interface; 'ip -details link show type can' lists those there are, and"
                f" 'canductor can doctor -c {options.channel}' says more"
            )
        if "Address family not supported" in said:
            return "this kernel has no CAN; load the module can-raw: 'modprobe can-raw'"
        if "Operation not permitted" in said or "Permission denied" in said:
            return f"opening it is not permitted ({said})"
    return (
        f"python-can cannot open it ({said}); its backends and their channels are named at"
        " python-can.readthedocs.io/en/stable/interfaces.html, and some need a driver"
    )
