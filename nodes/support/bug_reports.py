"""Reports of bugs in what handles others' messages: whoever calls such handlers goes on with the next one."""

import asyncio


class BugReports:
    """Reports to the loop's exception handler what could not be handled, the first failure of each kind."""

    def __init__(self) -> None:
        self._reported: set[str] = set()

    def add(self, what: str, bug: Exception) -> None:
        """Report that BUG kept WHAT, such as "node mcu: stats", from being handled."""
        if what not in self._reported:
            self._reported.add(what)
            message = f"{what} could not be handled; this is reported once"
            asyncio.get_running_loop().call_exception_handler({"message": message, "exception": bug})
