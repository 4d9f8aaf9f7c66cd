"""What a process takes of the computer: memory, descriptors, threads; and whether that grows."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Final

RSS_GROWTH_MAX_KIB: Final = 8192
"""From the median of the first quarter after the warm-up to that of the last: room for the allocator's own
fragments, less than what a leak of 10 KiB per print or client makes of a quarter of an hour."""
WARM_UP: Final = 0.25
"""Part of the samples that do not count: caches and rings fill."""
SAMPLES_MIN: Final = 8


@dataclass(frozen=True, slots=True)
class Footprint:
    """Of one process, at one time."""

    rss_kib: int
    descriptors: int
    threads: int


def of_process(pid: int, proc: Path = Path("/proc")) -> Footprint:
    """Measure process PID; raises OSError when it has ended."""
    status = dict(line.split(":", 1) for line in (proc / str(pid) / "status").read_text().splitlines())
    descriptors = len(list((proc / str(pid) / "fd").iterdir()))
    return Footprint(int(status["VmRSS"].split()[0]), descriptors, int(status["Threads"]))


def growth(samples: Sequence[Footprint]) -> Footprint:
    """Return by how much SAMPLES, taken at like moments, grow from their beginning to their end.

    Medians of a quarter each are compared, after the warm-up. Raises ValueError when there are too few.
    """
    settled = samples[int(len(samples) * WARM_UP) :]
    if len(settled) < SAMPLES_MIN:
        raise ValueError(f"{len(settled)} samples after the warm-up are too few to see growth")
    quarter = len(settled) // 4
    first, last = settled[:quarter], settled[-quarter:]
    return Footprint(
        int(median(s.rss_kib for s in last) - median(s.rss_kib for s in first)),
        int(median(s.descriptors for s in last) - median(s.descriptors for s in first)),
        int(median(s.threads for s in last) - median(s.threads for s in first)),
    )


def problems(name: str, samples: Sequence[Footprint]) -> list[str]:
    """Return a sentence for each quantity of process NAME that grows more than it may."""
    grown = growth(samples)
    found = []
    if grown.rss_kib > RSS_GROWTH_MAX_KIB:
        found.append(
            f"{name}: memory grew by {grown.rss_kib:,} KiB, at most {RSS_GROWTH_MAX_KIB:,} are allowed"
        )
    if grown.descriptors > 0:
        found.append(f"{name}: {grown.descriptors} more descriptors are open at the end")
    if grown.threads > 0:
        found.append(f"{name}: {grown.threads} more threads run at the end")
    return found
