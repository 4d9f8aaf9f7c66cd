"""One job and nothing else: a machine service without clients that ends with its only job."""

from collections.abc import Callable
from pathlib import Path

from coordinator.config.model import MachineDescription
from coordinator.gcode.program import Program
from coordinator.ipc.server.state import StateTree
from coordinator.runtime.host import Host
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.jobs.outcome import Outcome
from coordinator.streaming.move_source import ProgramOutput
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.progress import Progress
from nodes.dictionary.cache import DictionaryCache

OnProgress = Callable[[Progress], None]


async def run_job(
    description: MachineDescription,
    program: Program,
    on_progress: OnProgress | None = None,
    *,
    record: PlanRecord | None = None,
    on_output: Callable[[ProgramOutput], None],
    on_ready: Callable[[Machine], None] = lambda _: None,
    host: Host | None = None,
    cache: DictionaryCache | None = None,
    tables: Path | None = None,
) -> Outcome:
    """Connect to the machine, run PROGRAM on it and return the result.

    ON_OUTPUT gets what program and machine report, ON_READY the machine when its nodes are ready. CACHE keeps
    dictionaries; TABLES is the folder of accepted axis tables, which correct the axes.

    Raises CanductorError. Whatever ends the job early stops all nodes, except for an error of the program
    itself: what comes before the bad line is carried out, and the machine comes to a standstill.
    """
    service = MachineService(
        lambda: description,
        host or LinuxHost(),
        StateTree(),
        ServiceSettings(name="", tables=tables),
        cache=cache,
        record=record,
        on_line=lambda _: None,
        on_output=on_output,
    )
    return await service.run_job(program, on_ready=on_ready, on_progress=on_progress)
