"""Runs node discovery on an open bus; options common to the tools that ask nodes."""

import argparse
from typing import Final

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.bus.talk import LISTEN_S, BusTalk
from canbus_tools.discovery.node_discovery import ROUNDS, DiscoveredNodes, NodeDiscovery
from nodes.link import Frame
from nodes.support.can_protocol import BUS_OFF
from nodes.support.errors import CanductorError
from nodes.support.option_values import decimal

_CAUSE_S: Final = 0.2
"""The sentence why a bus ended comes from another thread, maybe a little after sending fails."""
_LISTEN_MIN_S: Final = 0.1
_LISTEN_MAX_S: Final = 60.0


async def discover_nodes(bus: BusTalk, rounds: int = ROUNDS) -> DiscoveredNodes:
    """Ask who is on BUS, ROUNDS times or more; raises CanductorError when the bus cannot be used."""
    discovery = NodeDiscovery(rounds)

    def came(frame: Frame) -> None:
        if frame.can_id == BUS_OFF:
            raise_later.append(bus_off(bus.name))
        discovery.frame(frame.can_id, frame.data)

    raise_later: list[CanductorError] = []
    end = bus.on_frame(came)
    try:
        # By a clock of its own, of the time that was waited: what this computer overslept beyond that, the
        # nodes' answers may have had to wait, too.
        now_ns = 0
        discovery.start(now_ns)
        while discovery.deadline_ns is not None and not raise_later:
            try:
                for frame in discovery.frames_to_send():
                    bus.send_frame(frame.can_id, frame.data)
            except CanductorError:
                await bus.wait(_CAUSE_S)  # which raises what ended the bus, and that tells more
                raise
            await bus.wait((discovery.deadline_ns - now_ns) * 1e-9)
            now_ns = discovery.deadline_ns
            discovery.timer(now_ns)
    finally:
        end()
    if raise_later:
        raise raise_later[0]
    return discovery.result()


def bus_off(bus: str) -> CanductorError:
    """Return what to say when the adapter took itself off the bus."""
    return CanductorError(
        f"the controller of {bus} met too many errors and went off the bus (bus-off): most often the bit "
        f"rate is not the nodes', or a cable or the termination is at fault; 'canductor can doctor -c {bus}' "
        f"checks, 'ip link set {bus} down' and 'ip link set {bus} up' bring it back"
    )


def declare_listen(command: argparse.ArgumentParser) -> None:
    """Add the option ``listen``: how long to listen for other hosts, in seconds."""
    command.add_argument(
        "--listen",
        type=decimal(_LISTEN_MIN_S, _LISTEN_MAX_S, "s"),
        metavar="S",
        default=LISTEN_S,
        help="how long to listen for other hosts first, in seconds",
    )


def where(options: BusOptions) -> str:
    """Return the options of a command line that name the bus."""
    interface = "" if options.interface == "socketcan" else f"-i {options.interface} "
    return f"{interface}-c {options.channel}"
