"""Virtual hardware for `canductor run`: the demo's boards, and a configuration file for them."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection
from coordinator.support.examples import DEMO_MACHINE
from coordinator.virtual_machine.virtual_machine import VirtualMachine, VirtualMachineOptions


@contextmanager
def hardware(config: Path, folder: Path, sections: str) -> Iterator[None]:
    """Run the demo's boards in FOLDER; write CONFIG, the demo's machine on them with SECTIONS added."""
    described = load_machine(str(DEMO_MACHINE))
    with VirtualMachine(described, VirtualMachineOptions(logs=False), folder) as machine:
        text = DEMO_MACHINE.read_text(encoding="utf-8")
        for real, virtual in zip(described.nodes, machine.description.nodes, strict=True):
            if isinstance(real.connection, CanConnection):
                assert isinstance(virtual.connection, CanConnection)
                old, new = real.connection.interface, virtual.connection.interface
                text = text.replace(f"canbus_interface: {old}\n", f"canbus_interface: {new}\n")
            else:
                assert not isinstance(virtual.connection, CanConnection)
                text = text.replace(real.connection.path, virtual.connection.path)
        config.write_text(text + sections, encoding="utf-8")
        yield
