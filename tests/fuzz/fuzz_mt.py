"""Fuzzes MT's receivers in Python and C against each other with atheris (pip install atheris).

Usage, from the project's root: python -m tests.fuzz.fuzz_mt [-max_total_time=S] [FOLDER]
"""

import sys
from importlib import import_module
from typing import Any

atheris: Any = import_module("atheris")  # has no types, and need not be installed to check this file

with atheris.instrument_imports(include=["nodes.mt"]):
    from tests.fuzz.mt_target import run_receivers


def main() -> None:
    """Run until -max_total_time is over or something fails."""
    atheris.Setup(sys.argv, run_receivers)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
