"""A host that heats and does nothing else, as a process that a test may kill: python heating_host.py CFG."""

import asyncio
import sys

from coordinator.app import Machine
from coordinator.gcode.commands import Call, InTime
from coordinator.gcode.words import parse
from coordinator.host import LinuxHost
from coordinator.machine.description import load_machine


async def main(path: str) -> None:
    machine = Machine(load_machine(path), LinuxHost())
    await machine.start()
    try:
        command = parse(b"M104 S250")
        assert command is not None
        call = Call(command, 1, (0.0, 0.0, 0.0, 0.0), "")
        reading = machine.modules.vocabulary.commands["M104"].read(call)
        assert isinstance(reading, InTime)
        reading.act(0.0)
        sys.stdout.write("heating\n")
        sys.stdout.flush()
        raise await machine.wait_stopped()
    finally:
        await machine.close()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
