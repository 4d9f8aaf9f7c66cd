"""A control group of Linux that limits the programs in it, of version 1 or 2; only root may make one."""

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path("/sys/fs/cgroup")
PERIOD_US = 100_000
"""Of processor time; what is used up is given again with the next one."""


@dataclass(frozen=True, slots=True)
class ControlGroup:
    """A group in FOLDERS, one for each hierarchy."""

    folders: tuple[Path, ...]

    def running(self, command: list[str]) -> list[str]:
        """Return the command that runs COMMAND in the group."""
        files = " ".join(str(folder / "cgroup.procs") for folder in self.folders)
        return ["sh", "-c", f'for file in {files}; do echo $$ > $file; done; exec "$@"', "sh", *command]

    @property
    def throttled(self) -> int:
        """In how many periods a program wanted more than there was."""
        words = (self.folders[0] / "cpu.stat").read_text().split()
        return int(words[words.index("nr_throttled") + 1])


@contextlib.contextmanager
def limited(core_share: float, memory_bytes: int) -> Iterator[ControlGroup]:
    """Make a group with CORE_SHARE of one core's time and so much memory; remove it once it is empty.

    Raises OSError where that is not permitted or the system has no such limits.
    """
    name, quota_us = f"canductor-bench-{os.getpid()}", round(core_share * PERIOD_US)
    if (ROOT / "cgroup.controllers").exists():
        (ROOT / "cgroup.subtree_control").write_text("+cpu +memory")
        folders = (ROOT / name,)
        limits = {folders[0] / "cpu.max": f"{quota_us} {PERIOD_US}"}
        limits[folders[0] / "memory.max"] = str(memory_bytes)
    else:
        folders = (ROOT / "cpu" / name, ROOT / "memory" / name)
        limits = {folders[0] / "cpu.cfs_period_us": str(PERIOD_US)}
        limits[folders[0] / "cpu.cfs_quota_us"] = str(quota_us)
        limits[folders[1] / "memory.limit_in_bytes"] = str(memory_bytes)
    with contextlib.ExitStack() as stack:
        for folder in folders:
            folder.mkdir()
            stack.callback(folder.rmdir)
        for file, text in limits.items():
            file.write_text(text)
        yield ControlGroup(folders)
