"""Runs node discovery on an open bus; the option common to the tools that query nodes."""

import argparse
from typing import Final

from canbus_tools.bus.talk import LISTEN_S, BusTalk
from canbus_tools.discovery.node_discovery import ROUNDS, DiscoveredNodes, NodeDiscovery
from nodes.link import Frame
from nodes.support.can_protocol import BUS_OFF
from nodes.support.errors import CanductorError
from nodes.support.option_values import decimal

_CAUSE_S: Final = 0.2
"""The cause of a bus's end is reported by another thread, perhaps shortly after sending fails."""
_LISTEN_MIN_S: Final = 0.1
_LISTEN_MAX_S: Final = 60.0


async def discover_nodes(bus: BusTalk, rounds: int = ROUNDS) -> DiscoveredNodes:
    """Query which nodes are on BUS, at least ROUNDS times; raises CanductorError if the bus fails."""
    discovery = NodeDiscovery(rounds)

    def came(frame: Frame) -> None:
        if frame.can_id == BUS_OFF:
            raise_later.append(bus_off(bus.name))
        discovery.frame(frame.can_id, frame.data)

    raise_later: list[CanductorError] = []
    end = bus.on_frame(came)
    try:
        # A clock that counts only the time waited: while this computer was late, answers may have been, too.
        now_ns = 0
        discovery.start(now_ns)
        while discovery.deadline_ns is not None and not raise_later:
            try:
                for frame in discovery.frames_to_send():
                    bus.send_frame(frame.can_id, frame.data)
            except CanductorError:
                await bus.wait(_CAUSE_S)  # raises the cause, if the bus has ended
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
    """Return the error for an adapter that is bus-off."""
    return CanductorError(
        f"the controller of {bus} detected too many errors and left the bus (bus-off); usual causes are a "
        "bit rate other than the nodes', a cable or the termination: check with 'canductor can doctor -c "
        f"{bus}', then restart it with 'ip link set {bus} down' and 'ip link set {bus} up'"
    )


def declare_listen(command: argparse.ArgumentParser) -> None:
    """Add the option ``listen``: time to listen for other hosts, in seconds."""
    command.add_argument(
        "--listen",
        type=decimal(_LISTEN_MIN_S, _LISTEN_MAX_S, "s"),
        metavar="S",
        default=LISTEN_S,
        help="time to listen for other hosts before sending, in seconds",
    )
