"""How long a node may be away, and what the user reads meanwhile.

A board that was reset is away until its boot loader has ended; on USB its device disappears for that time.
A board on a serial line may be away when the line is opened, too: opening raises DTR, which resets many
boards, and their boot loaders are deaf for up to 3 s. On a bus it may just have been given power, or restart
by itself, or be held up; a node that others can do without is not waited for there.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from nodes.node.errors import NodeLost
from nodes.support.errors import CanductorError

BACK_WITHIN_S: Final = 10.0
"""From a reset until the node has to answer."""
DEAF_S: Final = 4.0
"""From the begin of a start until the node has to answer: a boot loader's 3 s, and the time to answer."""
RETRY_S: Final = 0.1
"""Between two attempts to reach the node."""
FIRST_NOTICE_S: Final = 1.0
"""Shorter absences are not mentioned."""
NOTICE_INTERVAL_S: Final = 3.0
REQUESTED: Final = "a restart of its firmware was requested"
"""Why a node is reset that is configured as it should be."""
LOST_IN_START: Final = "it was lost while it was started"
"""Likewise: what it still does from before may be what keeps it from answering."""


class Absence:
    """The time in which node NAME may be away, from now on for LIMIT_S; 0: it has to answer at once.

    AFTER: what made it go away, as a clause ("it was reset because …"); "": nothing that is known.
    ON_NOTICE gets a sentence while it lasts.
    """

    def __init__(self, name: str, limit_s: float, after: str, on_notice: Callable[[str], None]) -> None:
        self._name = name
        self.limit_s = limit_s
        self._after = after
        self._on_notice = on_notice
        self._began_s = asyncio.get_running_loop().time()
        self._notice_s = FIRST_NOTICE_S
        self._noticed = False

    @property
    def after_reset(self) -> bool:
        """Whether the node was made to go away."""
        return bool(self._after)

    def goes_on(self, missing: str) -> bool:
        """Return whether to try again after an attempt found the node MISSING (a clause); notify the user."""
        passed_s = self._passed_s()
        if passed_s >= self.limit_s:
            return False
        if passed_s >= self._notice_s and self.after_reset:
            self._noticed = True
            self._notice_s = passed_s + NOTICE_INTERVAL_S
            self._on_notice(
                f"node {self._name}: {self._after}; waiting until it is back "
                f"({missing}; {passed_s:.0f} of {self.limit_s:.0f} s)"
            )
        return True

    def ended(self) -> None:
        """Notify the user that the node answers, if its absence was mentioned."""
        if self._noticed:
            self._on_notice(f"node {self._name} is back after {self._passed_s():.1f} s")

    def error(self, missing: str, found: CanductorError) -> CanductorError:
        """Return why the start failed: FOUND by the last attempt, or that the node did not come back."""
        if not self.after_reset:
            return found
        return NodeLost(
            f"node {self._name} did not come back within {self.limit_s:.0f} s: {self._after}, and now "
            f"{missing}"
        )

    def _passed_s(self) -> float:
        return asyncio.get_running_loop().time() - self._began_s
