"""Turns of the control loop, one for each script: however many clients send some, each is read alone."""

import asyncio


class Turns:
    """Shares them out in the order in which they are asked for."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()

    async def next(self) -> None:
        """Wait for a turn that nobody else has."""
        async with self._lock:
            await asyncio.sleep(0)
