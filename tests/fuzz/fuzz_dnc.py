"""Fuzzes both roles of BCC with atheris (pip install atheris): any bytes from a line.

Usage, from the project's root: python -m tests.fuzz.fuzz_dnc [-max_total_time=S] [FOLDER]
"""

import sys
from importlib import import_module
from typing import Any

atheris: Any = import_module("atheris")  # has no types, and need not be installed to check this file

with atheris.instrument_imports(include=["coordinator.dnc"]):
    from tests.fuzz.dnc_target import PIECES, run_engine


def mutate(data: bytes, max_size: int, seed: int) -> bytes:
    """Append a sound piece now and then; else as libFuzzer does."""
    if seed % 3:
        return bytes(atheris.Mutate(data, max_size))
    return (data + PIECES[seed // 3 % len(PIECES)])[:max_size]


def run(data: bytes) -> None:
    """The first four bytes decide about pieces and times."""
    run_engine(data[4:], int.from_bytes(data[:4], "little") & 0x7FFFFFFF)


def main() -> None:
    """Run until -max_total_time is over or something fails."""
    atheris.Setup(sys.argv, run, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
