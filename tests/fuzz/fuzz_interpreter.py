"""Fuzzes the interpreter with atheris (pip install atheris): any bytes as a program.

Usage, from the project's root: python -m tests.fuzz.fuzz_interpreter [-max_total_time=S] [FOLDER]
"""

import sys
from importlib import import_module
from typing import Any

atheris: Any = import_module("atheris")  # has no types, and need not be installed to check this file

with atheris.instrument_imports(include=["coordinator.gcode", "coordinator.kinematics"]):
    from tests.fuzz.interpreter_target import TOKENS, run_program


def mutate(data: bytes, max_size: int, seed: int) -> bytes:
    """Put a word in now and then; else as libFuzzer does."""
    if seed % 3:
        return bytes(atheris.Mutate(data, max_size))
    at = seed // 3 % (len(data) + 1)
    joint = b"\n" if seed // 7 % 4 == 0 else b" "
    return (data[:at] + joint + TOKENS[seed // 11 % len(TOKENS)] + joint + data[at:])[:max_size]


def main() -> None:
    """Run until -max_total_time is over or something fails."""
    atheris.Setup(sys.argv, run_program, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
