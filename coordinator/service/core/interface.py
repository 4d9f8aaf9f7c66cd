"""What jobs, programs and figures need of the machine service; ``machine_service.py`` provides it."""

from pathlib import Path
from typing import Protocol

from coordinator.ipc.server.state import StateTree
from coordinator.runtime.machine import Machine
from coordinator.service.core.motion import Motion
from coordinator.service.core.work import FileWork
from coordinator.service.jobs.job_folder import JobFolder
from coordinator.service.jobs.jobs import JobRun
from coordinator.service.state.log_ring import LogRing
from coordinator.streaming.move_source import ProgramOutput


class ServiceInterface(Protocol):
    """One machine and its job, on the control loop."""

    tree: StateTree
    log: LogRing
    folder: JobFolder | None
    machine: Machine | None
    motion: Motion | None
    job: JobRun | None
    confirmed_s: dict[str, float]

    @property
    def now_s(self) -> float: ...  # noqa: D102
    @property
    def active_job(self) -> JobRun | None: ...  # noqa: D102
    def ready_motion(self) -> Motion: ...  # noqa: D102
    def up_machine(self) -> Machine: ...  # noqa: D102
    def job_folder(self, otherwise: Path) -> JobFolder: ...  # noqa: D102
    def start_job(  # noqa: D102
        self, work: FileWork, *, behind_others: bool = False, fed: bool = False
    ) -> JobRun: ...
    def report(self, output: ProgramOutput) -> None: ...  # noqa: D102
