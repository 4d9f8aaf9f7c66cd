"""A host that heats and does nothing else, as a process that may be killed; arguments: CONFIG CELSIUS."""

import asyncio
import sys

from coordinator.assembly.load import load_machine
from coordinator.gcode.commands import Call, Synchronized
from coordinator.gcode.parser import parse
from coordinator.modules.module_set import build_modules
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine


async def main(path: str, celsius: float) -> None:
    """Heat the hotend of the machine in PATH until the machine stops; raises why it did."""
    description = load_machine(path)
    machine = Machine(description, LinuxHost(), build_modules(description))
    await machine.start()
    try:
        command = parse(f"M104 S{celsius:g}".encode())
        assert command is not None
        call = Call(command, 1, (0.0, 0.0, 0.0, 0.0), "")
        reading = machine.modules.vocabulary.commands["M104"].read(call)
        assert isinstance(reading, Synchronized)
        reading.act(0.0)
        sys.stdout.write("heating\n")
        sys.stdout.flush()
        raise await machine.wait_stopped()
    finally:
        await machine.close()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], float(sys.argv[2])))
