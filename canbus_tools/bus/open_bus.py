"""Opening the CAN bus of a tool, with the same options as python-can's own tools."""

import argparse
from dataclasses import dataclass, replace
from typing import Any

import can

from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, integer

BITRATE_MIN, BITRATE_MAX = 10_000, 1_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class BusOptions:
    """A CAN bus, and how to open it."""

    interface: str = "socketcan"
    """Backend of python-can; ``canductor``: the project's virtual bus, with its socket as CHANNEL."""
    channel: str = "can0"
    bitrate: int | None = None
    """Bit/s; None: that of the interface."""
    listen_only: bool = False
    """Whether to send nothing, not even acknowledgements; only some adapters support it."""

    @property
    def short_name(self) -> str:
        """Name in recordings and lines: the last part of a path."""
        return self.channel.rpartition("/")[2] or self.channel

    @property
    def name(self) -> str:
        """Name in messages."""
        return self.channel if self.is_socketcan else f"{self.interface}:{self.channel}"

    @property
    def is_socketcan(self) -> bool:
        """Whether it is a network interface of Linux."""
        return self.interface == "socketcan"

    @property
    def arguments(self) -> str:
        """The bus as options of a command line: ``-c can0``."""
        return f"{'' if self.is_socketcan else f'-i {self.interface} '}-c {self.channel}"

    def without_bitrate(self) -> "BusOptions":
        """Return the same without the bit rate if only the system can set that."""
        return replace(self, bitrate=None) if self.interface in ("socketcan", "canductor") else self


def declare_bus(command: argparse.ArgumentParser) -> None:
    """Add the options that select the bus."""
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
    """Open the bus; raises CanductorError with the cause and what to do."""
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
                "there is no such interface; 'ip -details link show type can' lists all CAN interfaces, and "
                f"'canductor can doctor -c {options.channel}' checks this one"
            )
        if "Address family not supported" in said:
            return "this kernel has no support for CAN; load the module: 'modprobe can-raw'"
        if "Operation not permitted" in said or "Permission denied" in said:
            return f"opening it is not permitted ({said})"
    return (
        f"python-can cannot open it ({said}); python-can.readthedocs.io/en/stable/interfaces.html describes "
        "its backends and their channels; some need a driver"
    )
