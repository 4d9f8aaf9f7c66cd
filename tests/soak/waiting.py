"""How long processes that could run waited for a processor: whether a failure is the computer's load."""

from pathlib import Path


def family(pid: int, proc: Path = Path("/proc")) -> list[int]:
    """Return PID and the processes that it has started, and those that they have, as far as they run."""
    children: dict[int, list[int]] = {}
    for folder in proc.glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        children.setdefault(int(fields[1]), []).append(int(folder.name))
    found = [pid]
    for parent in found:
        found += children.get(parent, [])
    return found


def waited_s(pid: int, proc: Path = Path("/proc")) -> float:
    """Return how long the threads of process PID have waited for a processor so far; 0: it has ended.

    The second figure of ``schedstat`` (Linux: Documentation/scheduler/sched-stats.rst), in ns.
    """
    waited_ns = 0
    for task in (proc / str(pid) / "task").glob("*"):
        try:
            waited_ns += int((task / "schedstat").read_text().split()[1])
        except OSError:  # it has ended
            continue
    return waited_ns / 1e9


def command_of(pid: int, proc: Path = Path("/proc")) -> str:
    """Return what the process PID is called, as ``ps`` shows it."""
    try:
        return f"{(proc / str(pid) / 'comm').read_text().strip()} ({pid})"
    except OSError:
        return f"({pid}, ended)"
