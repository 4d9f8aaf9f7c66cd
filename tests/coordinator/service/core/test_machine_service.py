"""The service's own tasks, without a machine."""

import asyncio
from collections.abc import Iterator
from typing import Any, NoReturn, cast

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.server.state import StateTree
from coordinator.runtime.host import Host
from coordinator.service.core.machine_service import REFRESH_S, MachineService, ServiceSettings, ServiceState
from coordinator.service.state.figures import Figures
from tests.stages.jump_loop import run


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


class VirtualHost:
    """A host whose time is the running loop's."""

    def now(self) -> int:
        return round(asyncio.get_running_loop().time() * 1e9)


def service_of(tree: StateTree) -> MachineService:
    settings = ServiceSettings(name="test")
    return MachineService(_load, cast("Host", VirtualHost()), tree, settings, on_line=lambda _: None)


@pytest.mark.parametrize("state", [ServiceState.STARTUP, ServiceState.READY, ServiceState.SHUTDOWN])
def test_a_restart_looks_for_unread_stops_only_where_it_is_possible(state: ServiceState) -> None:
    """Failed before: while a job printed each call looked through all that clients had sent."""
    service, looks = service_of(StateTree()), list[None]()
    service.find_unread_stop = lambda: looks.append(None) or "me"  # type: ignore[func-returns-value]
    service.state = state
    with pytest.raises(ApiError) as raised:
        service.restart()
    assert ("by me has just come" in raised.value.sentence) == bool(looks) == (state is ServiceState.SHUTDOWN)


class BrokenFigures:
    """Figures of a machine with a module that has a bug."""

    def __init__(self, tree: StateTree) -> None:
        self.has_bug = True
        self.shown = 0
        self._tree = tree

    def parts(self, _: MachineService) -> Iterator[None]:
        self.shown += 1
        self._tree.set("job.state", "none")
        yield
        if self.has_bug:
            raise ZeroDivisionError(f"status {self.shown}")
        self._tree.set("modules.x", self.shown)

    def show(self, service: MachineService) -> None:
        for _ in self.parts(service):
            pass


def test_a_bug_in_what_is_shown_is_reported_once_and_ends_nothing() -> None:
    """Failed before: the state was not refreshed any more, and whoever read it got the exception."""
    reports: list[dict[str, Any]] = []

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: reports.append(context))
        tree = StateTree()
        service = service_of(tree)
        figures = BrokenFigures(tree)
        service._figures = cast("Figures", figures)
        refresh = asyncio.ensure_future(service._refresh())
        await asyncio.sleep(0)
        for _ in range(5):
            assert tree.snapshot().values == {"job.state": "none"}
            await asyncio.sleep(3 * REFRESH_S)
        figures.has_bug = False
        await asyncio.sleep(2 * REFRESH_S)
        assert tree.latest("modules.x") == figures.shown
        assert not refresh.done()
        refresh.cancel()

    run(main())
    (report,) = reports
    assert isinstance(report["exception"], ZeroDivisionError)
