"""A tool's start does not pay for what only another one needs."""

import json
import subprocess
import sys

from canbus_tools.tools.parser import CONSOLE, TOOLS

HEAVY = {"numpy", "textual", "prompt_toolkit", "rich", "matplotlib", "coordinator.motion"}


def test_no_tool_draws_in_what_it_does_not_need() -> None:
    modules = [f"canbus_tools.{module}" for module, _ in (*TOOLS.values(), CONSOLE)]
    script = (
        "import importlib, json, sys\n"
        f"for module in {modules!r}: importlib.import_module(module)\n"
        "print(json.dumps(sorted(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not HEAVY & set(json.loads(done.stdout))
