"""A simulated world in which things happen at set times, whatever the host is doing."""

import heapq
import itertools
from collections.abc import Callable

from nodes.virtual.world import World


class ScriptedWorld(World):
    """A world with a script: ``at`` puts something into it."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._script: list[tuple[int, int, Callable[[], object], bool]] = []
        self._count = itertools.count()

    def at(self, at_ns: int, what: Callable[[], object], *, wakes: bool = False) -> None:
        """Call WHAT at AT_NS of true time, between two events; WAKES: Python goes on at once after it."""
        heapq.heappush(self._script, (max(at_ns, self.now_ns), next(self._count), what, wakes))

    def run_until(self, until_ns: int) -> bool:
        """Let time pass, as World does, and what is in the script happen."""
        while self._script and self._script[0][0] <= until_ns:
            at_ns, _, what, wakes = self._script[0]
            if super().run_until(at_ns):
                return True
            heapq.heappop(self._script)
            what()
            if wakes:
                return True
            # A host that has just been stalled does not go on when it meant to.
            until_ns = max(until_ns, self.python_wakes_ns(until_ns)) if until_ns > at_ns else until_ns
        return super().run_until(until_ns)
