"""Locked memory; each in a process of its own."""

import json
import subprocess
import sys

import pytest

SHOWN = """
import json, mmap, resource, sys
from coordinator.support.locked_memory import lock_memory
if sys.argv[1] != "as it is":
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (int(sys.argv[1]), int(sys.argv[1])))
granted = lock_memory()
reserved = mmap.mmap(-1, 64 << 20)
reserved[:4096] = bytes(4096)
with open("/proc/self/status") as status:
    kib = {line.split(":")[0]: line.split()[1:2] for line in status}
print(json.dumps([granted, int(kib["VmLck"][0]), int(kib["VmRSS"][0])]))
"""


def locked(limit: str, *prefix: str) -> tuple[bool, int, int]:
    """Return whether it was granted, what is locked, reserved memory included, and what is used, KiB."""
    shown = subprocess.run(
        [*prefix, sys.executable, "-c", SHOWN, limit], capture_output=True, text=True, check=True, timeout=60
    )
    granted, locked_kib, used_kib = json.loads(shown.stdout)
    return granted, locked_kib, used_kib


def test_what_is_used_stays_and_what_is_only_reserved_takes_nothing() -> None:
    granted, locked_kib, used_kib = locked("as it is")
    if not granted:
        pytest.skip("locked memory is limited here (ulimit -l)")
    assert locked_kib > 64 << 10
    assert used_kib < 64 << 10


def test_with_a_limit_nothing_is_locked_and_nothing_fails() -> None:
    without = "setpriv", "--bounding-set", "-ipc_lock", "--inh-caps", "-ipc_lock"
    prefix = without if locked("as it is")[0] else ()
    granted, locked_kib, _ = locked(str(8 << 20), *prefix)
    assert (granted, locked_kib) == (False, 0)
