"""Sends a file into a machine's job folder, in parts."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coordinator.ipc.client.client import Client
from coordinator.ipc.client.target import Target
from coordinator.ipc.server.uploads import PART_MAX
from nodes.support.option_values import regular_file
from nodes.support.terminal import show


def show_progress(sent: int, size: int) -> None:
    """Show on a terminal how many bytes of a file were sent."""
    if sys.stderr.isatty():
        end = "\n" if sent >= size else ""
        show(f"sent {sent:,} of {size:,} bytes", sys.stderr, before="\r", end=end)


def send_program(
    target: Target,
    file: Path,
    name: str,
    *,
    replace: bool,
    start: bool,
    on_progress: Callable[[int, int], object] | None = None,
) -> Any:
    """Send FILE as NAME to TARGET, and print it if START; return the machine's answer.

    ON_PROGRESS gets the bytes sent and those of the whole file. Raises CanductorError.
    """
    size = regular_file(file).stat().st_size

    async def send(client: Client) -> Any:
        sent = 0
        with file.open(encoding="utf-8", errors="replace", newline="") as text:
            part = text.read(PART_MAX)
            done = False
            while not done:
                following = text.read(PART_MAX)
                done = not following
                params: dict[str, Any] = {
                    "file": name,
                    "offset": sent,
                    "text": part,
                    "done": done,
                    "replace": replace,
                }
                sent = (await client.call("job.upload", params))["size_bytes"]
                if on_progress is not None:
                    on_progress(sent, size)
                part = following
        return await client.call("job.start", {"file": name}) if start else {"size_bytes": sent}

    return target.run(send)
