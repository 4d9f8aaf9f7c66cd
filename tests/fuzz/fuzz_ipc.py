"""Fuzzes a session of the interface with atheris (pip install atheris): any bytes from a client.

Usage, from the project's root: python -m tests.fuzz.fuzz_ipc [-max_total_time=S] [FOLDER]
"""

import sys
from importlib import import_module
from typing import Any

atheris: Any = import_module("atheris")  # has no types, and need not be installed to check this file

with atheris.instrument_imports(include=["coordinator.ipc"]):
    from tests.fuzz.ipc_target import REQUESTS, line, packed, run_session


def mutate(data: bytes, max_size: int, seed: int) -> bytes:
    """Append a sound request now and then; else as libFuzzer does."""
    if seed % 3:
        return bytes(atheris.Mutate(data, max_size))
    write = line if data[:1] == b"{" else packed
    return (data + write(REQUESTS[seed // 3 % len(REQUESTS)]))[:max_size]


def main() -> None:
    """Run until -max_total_time is over or something fails."""
    atheris.Setup(sys.argv, run_session, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
