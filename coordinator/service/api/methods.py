"""All methods of the machine's interface, and what every one of them may rely on."""

from collections.abc import Iterable

from coordinator.ipc.protocol.methods import Method, Registry
from coordinator.service.api.jobs import job_methods
from coordinator.service.api.machine import machine_methods
from coordinator.service.api.motion import motion_methods
from coordinator.service.api.nodes import node_methods
from coordinator.service.api.plots import plot_methods
from coordinator.service.api.tables import table_methods
from coordinator.service.core.machine_service import MachineService


def add_methods(service: MachineService, registry: Registry) -> None:
    """Add the methods of SERVICE to REGISTRY."""
    for method in _every(service):
        registry.add(method)


def _every(service: MachineService) -> Iterable[Method]:
    yield from machine_methods(service)
    yield from motion_methods(service)
    yield from job_methods(service)
    yield from node_methods(service)
    yield from plot_methods(service)
    yield from table_methods(service)
