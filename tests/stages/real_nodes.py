"""A machine's virtual nodes as processes, with their plants, for what is to be seen in real time."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection
from coordinator.support.toml_values import Dice
from coordinator.virtual_machine.plant import PlantSettings, machine_plants
from nodes.virtual.hub import VirtualBus
from nodes.virtual.plant_page import PlantPage
from nodes.virtual.processes import NodeProcess

CONFIG: Final = "printer.cfg"
"""The configuration's name in the folder."""
RATE_PPM: Final = 50.0
"""By how much a node's clock is too fast or too slow, at most."""
CLOCK_LIMIT: Final = 2**40
"""Clocks begin anywhere below this."""


@contextmanager
def real_nodes(
    machine: Path, folder: Path, settings: PlantSettings | None = None, *, loss: float = 0.0, seed: int = 1
) -> Iterator[dict[str, PlantPage]]:
    """Run the nodes of MACHINE (all on can0, the first a main board) in FOLDER; yield their plants' pages.

    SEED decides their clocks and which frames get lost: LOSS is their share. FOLDER then has a configuration
    that reaches them, and for each node NAME.edges, the log of its pins.
    """
    bus, config, dice = folder / "can.bus", folder / CONFIG, Dice("real nodes", seed).stream("clocks")
    text = machine.read_text(encoding="utf-8")
    config.write_text(text.replace("canbus_interface: can0", f"canbus_interface: virtual:{bus}"))
    described = load_machine(str(config))
    plants = machine_plants(described, settings)
    with ExitStack() as stack:
        stack.enter_context(VirtualBus(bus, loss=loss, seed=seed))
        nodes = []
        for number, node in enumerate(described.nodes):
            assert isinstance(node.connection, CanConnection)
            process = NodeProcess(
                "toolhead" if number else "mainboard",
                uuid=node.connection.uuid,
                can=bus,
                rate_ppm=dice.uniform(-RATE_PPM, RATE_PPM),
                start_clock=dice.randrange(CLOCK_LIMIT),
                edge_log=folder / f"{node.name}.edges",
                plant=plants[node.name].write(folder),
            )
            nodes.append(stack.enter_context(process))
        for process in nodes:
            process.wait_ready()
        yield {node.name: PlantPage.at(folder, node.name) for node in described.nodes}
