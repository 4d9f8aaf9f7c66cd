"""``move.home`` takes letters of axes and makes nothing else into g-code."""

import asyncio
from typing import NoReturn

import pytest

from coordinator.ipc.protocol.methods import ApiError, Caller, Scope
from coordinator.ipc.server.state import StateTree
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.api.motion import motion_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings


def _load() -> NoReturn:
    raise AssertionError("the service is not run")


def code_of(axes: str) -> str:
    """Return the code with which homing AXES is refused by a service without a machine."""

    async def main() -> str:
        settings = ServiceSettings(name="test")
        service = MachineService(_load, LinuxHost(), StateTree(), settings, on_line=lambda _entry: None)
        (home,) = [method for method in motion_methods(service) if method.name == "move.home"]
        with pytest.raises(ApiError) as refused:
            await home.call(Caller("a test", Scope.OPERATE), home.check({"axes": axes}))  # type: ignore[misc]
        return refused.value.code

    return asyncio.run(main())


@pytest.mark.parametrize("axes", [";Z", "X;Z", "X\n", "XX", "xX", " ", "E", "\u017f", "\x1b", "X("])
def test_what_are_no_axes_is_refused(axes: str) -> None:
    assert code_of(axes) == "bad_params"


@pytest.mark.parametrize("axes", ["", "x", "zy", "XYZ"])
def test_axes_are_taken(axes: str) -> None:
    assert code_of(axes) == "not_ready"
