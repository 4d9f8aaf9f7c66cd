"""A simulated world: nodes, wires and the host's adapters under virtual time, all from one seed."""

from nodes.virtual.world.loop import Stuck, VirtualLoop, run
from nodes.virtual.world.parts import CanController, CanPort, CanState, CanWire, Port, Uart, UartPort
from nodes.virtual.world.settings import (
    ControllerSettings,
    Latency,
    NodeSettings,
    PortSettings,
    UartSettings,
    WorldError,
)
from nodes.virtual.world.world import World, WorldNode

__all__ = [
    "CanController",
    "CanPort",
    "CanState",
    "CanWire",
    "ControllerSettings",
    "Latency",
    "NodeSettings",
    "Port",
    "PortSettings",
    "Stuck",
    "Uart",
    "UartPort",
    "UartSettings",
    "VirtualLoop",
    "World",
    "WorldError",
    "WorldNode",
    "run",
]
