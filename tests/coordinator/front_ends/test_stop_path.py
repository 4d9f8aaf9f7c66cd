"""The stop path stops the machine for which a stop was sent, and no other."""

import asyncio
import threading
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.front_ends.stop_path import StopPath
from coordinator.ipc.server.state import StateTree
from coordinator.modules.module_set import build_modules
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.service.core.machine_service import MachineService, ServiceSettings, ServiceState
from tests.stages import jump_loop

CONFIG = Path("config/corexy_toolhead.cfg")


def _machine() -> Machine:
    description = load_machine(str(CONFIG))
    return Machine(description, LinuxHost(), build_modules(description))


def _service() -> MachineService:
    return MachineService(
        lambda: load_machine(str(CONFIG)),
        LinuxHost(),
        StateTree(),
        ServiceSettings(name="test"),
        on_line=lambda _entry: None,
    )


def look(path: StopPath) -> None:
    """Look as the watchdog's thread does, while the loop has no turn."""
    thread = threading.Thread(target=path._while_held, args=(lambda: True,))
    thread.start()
    thread.join()


def test_a_machine_that_began_during_a_look_is_not_stopped() -> None:
    """The loop read the stop while the thread looked, and a restart followed; failed before."""

    async def main() -> None:
        service = _service()
        service.state = ServiceState.SHUTDOWN
        path = StopPath(service)
        before, after = _machine(), _machine()
        service.machine = before

        def find() -> str:
            before.stop("by the loop")
            service.machine = after
            return "me"

        path.lane.look_also(find)
        look(path)
        await asyncio.sleep(0)
        assert after.stopped is None
        path.close()

    jump_loop.run(main())


def test_a_machine_that_begins_before_the_stop_is_entered_is_not_stopped() -> None:
    """The same, when the thread had just sent the stop to the nodes."""

    async def main() -> None:
        service = _service()
        service.state = ServiceState.SHUTDOWN
        path = StopPath(service)
        before, after = _machine(), _machine()
        service.machine = before
        path.lane.look_also(lambda: "me")
        look(path)
        service.machine = after
        await asyncio.sleep(0)
        assert after.stopped is None
        service.machine = before
        look(path)
        await asyncio.sleep(0)
        assert before.stopped is None, "it was done already"
        path.close()

    jump_loop.run(main())


def test_the_machine_is_stopped_for_who_is_found() -> None:
    async def main() -> None:
        service = _service()
        service.state = ServiceState.READY
        path, machine = StopPath(service), _machine()
        service.machine = machine
        path.lane.look_also(lambda: "me")
        look(path)
        assert machine.stopped is None, "the loop enters it, when it can"
        await asyncio.sleep(0)
        assert str(machine.stopped) == "emergency stop by me"
        path.close()

    jump_loop.run(main())
