"""Recovery of nodes that may be absent: notices, reconnection, and the job that waits meanwhile."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Mapping
from typing import Final, Protocol

from coordinator.config.model import NodePolicy
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

FIRST_TRY_S: Final = 0.5
"""From the loss of a node to the first try to bring it back; doubled after each."""
LAST_TRY_S: Final = 10.0


class PausableJob(Protocol):
    """A job that can be made to wait, or to hurry."""

    def hold(self, cause: str) -> None:
        """Bring the job to a standstill; CAUSE is a sentence."""

    def release(self) -> None:
        """Resume the job; no effect on one that is not held."""

    def call(self) -> None:
        """Have the job look at once at what has happened."""


class NodeRecovery:
    """Reconnects nodes of POLICIES other than fatal, without limit of time.

    BRING_BACK restarts a node once (CanductorError: not yet), ON_NOTICE gets a sentence when a node is gone
    and one when it is back, NOW_S is any clock in s.
    """

    def __init__(
        self,
        policies: Mapping[str, NodePolicy],
        *,
        bring_back: Callable[[Node], Awaitable[None]],
        on_notice: Callable[[str], None],
        now_s: Callable[[], float],
    ) -> None:
        self._policies = policies
        self._bring_back = bring_back
        self._on_notice = on_notice
        self._now_s = now_s
        self._out: dict[str, asyncio.Task[None]] = {}
        self._gate: PausableJob | None = None
        self._halted = False

    @property
    def out(self) -> tuple[str, ...]:
        """Names of the nodes that are being brought back."""
        return tuple(self._out)

    def begin_job(self, gate: PausableJob) -> None:
        """Hold GATE whenever a node with policy pause is absent."""
        self._gate = gate
        for name in self._out:
            self._hold_for(name, f"node {name} is not there")

    def end_job(self) -> None:
        """Forget the job."""
        self._gate = None

    def start(self, node: Node) -> None:
        """Recover NODE, which is lost or shut down; without effect when that is under way."""
        if node.name in self._out or self._halted:
            return
        task = asyncio.get_running_loop().create_task(self._recover(node))
        task.add_done_callback(_report_bug)
        self._out[node.name] = task
        if self._policies[node.name] is NodePolicy.PAUSE and self._gate is not None:
            self._on_notice(f"{node.failure}; the job pauses until the node is back")
        else:
            self._on_notice(f"{node.failure}; its features are off until it is back")
        self._hold_for(node.name, str(node.failure))

    async def cancel(self, name: str) -> None:
        """Recover a node no longer: it is away on purpose."""
        task = self._out.pop(name, None)
        if task is not None:
            await _end(task)
            self._release_if_complete()

    def halt(self) -> None:
        """Leave all nodes as they are from now on: the machine was stopped."""
        self._halted = True
        for task in self._out.values():
            task.cancel()

    async def close(self) -> None:
        """End all recovery."""
        self.halt()
        tasks, self._out = tuple(self._out.values()), {}
        for task in tasks:
            await _end(task)

    async def _recover(self, node: Node) -> None:
        began_s = self._now_s()
        wait_s = FIRST_TRY_S
        while node.state is not NodeState.READY:
            await asyncio.sleep(wait_s)
            wait_s = min(2 * wait_s, LAST_TRY_S)
            with contextlib.suppress(CanductorError):  # reported once, when it was lost
                await self._bring_back(node)
        del self._out[node.name]
        self._on_notice(f"node {node.name} is back after {self._now_s() - began_s:.1f} s")
        self._release_if_complete()

    def _hold_for(self, name: str, cause: str) -> None:
        if self._gate is not None and self._policies[name] is NodePolicy.PAUSE:
            self._gate.hold(cause)

    def _release_if_complete(self) -> None:
        waits_for = [name for name in self._out if self._policies[name] is NodePolicy.PAUSE]
        if self._gate is not None and not waits_for:
            self._gate.release()


def _report_bug(task: asyncio.Task[None]) -> None:
    bug = None if task.cancelled() else task.exception()
    if bug is not None:
        task.get_loop().call_exception_handler({"message": "bringing a node back failed", "exception": bug})


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait([task])
