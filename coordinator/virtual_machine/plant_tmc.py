"""The stepper drivers of a configured machine that have a UART: they keep their registers and feel stalls."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from coordinator.config.file import ConfigFile, RawSection, parse_config
from coordinator.config.model import MachineDescription
from coordinator.config.pins import PinDescription, PinOption
from coordinator.config.sections.nodes import make_pin_registry
from coordinator.drivers.tmc_chips import CHIPS
from nodes.support.errors import CanductorError
from nodes.virtual.plant import Diag, Tmc

_SHARED: Final = "plant"


@dataclass(slots=True)
class NodeDrivers:
    """What a node's plant has of them."""

    tmcs: list[Tmc] = field(default_factory=list)
    diags: list[Diag] = field(default_factory=list)


def machine_drivers(description: MachineDescription) -> dict[str, NodeDrivers]:
    """Return the drivers and their DIAG pins by node; raises CanductorError for what a plant cannot have."""
    found = {node.name: NodeDrivers() for node in description.nodes}
    config = parse_config(description.path)
    nodes = {stepper.name: stepper for stepper in description.steppers}
    for section in config.sections.values():
        if section.kind not in CHIPS or section.instance not in nodes:
            continue
        stepper = nodes[section.instance]
        pins = dict(_pins(config, section, description))
        rx, tx, diag = pins["uart_pin"], pins.get("tx_pin", pins["uart_pin"]), pins.get("diag_pin")
        if rx.node != stepper.node:
            raise CanductorError(
                f"[{section.name}] has its UART on node {rx.node} and its stepper on {stepper.node}; the"
                " plant of a demo can only have both on one node"
            )
        address = section.options.get("uart_address")
        found[stepper.node].tmcs.append(
            Tmc(
                name=stepper.name,
                chip=section.kind,
                stepper=stepper.name,
                tx_pin=tx.name,
                rx_pin=rx.name,
                microsteps=stepper.microsteps,
                address=0 if address is None else int(address.value),
            )
        )
        if diag is not None:
            found[diag.node].diags.append(Diag(pin=diag.name, node=stepper.node, tmc=stepper.name))
    return found


def _pins(
    config: ConfigFile, section: RawSection, description: MachineDescription
) -> Iterator[tuple[str, PinDescription]]:
    registry = make_pin_registry(config, description.nodes)
    for name in ("uart_pin", "tx_pin", "diag_pin"):
        if name in section.options:
            option = PinOption(name=name, help="", pullable=True, share=_SHARED)
            yield name, registry.claim(option.parse(section.options[name].value), option, section)
