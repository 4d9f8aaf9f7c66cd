"""A pytest plugin: which test executes which statements, of C and of Python.

``pytest -p tests.mutation.coverage_plugin`` in a copy whose C is instrumented. The environment variable
MUTATION_COLLECT names a folder: of every test module one JSON file is written there as soon as it is through.
What a module's first test sets up counts for all its tests, since they share what it left.
"""

import ctypes
import json
import os
import time
from collections import defaultdict
from collections.abc import Generator, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import coverage
import numpy as np
import numpy.typing as npt
import pytest

from tests.mutation.areas import MODULES, files

_SETUP: Final = "|setup"


class Collector:
    """Gathers what tests execute."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._root = Path.cwd()
        python = [str(self._root / file) for file in files() if file.endswith(".py")]
        self._coverage = coverage.Coverage(data_file=None, include=python, config_file=False, messages=False)
        # That tests of C execute none of the Python in question is no reason for a warning.
        self._coverage.set_option("run:disable_warnings", ["no-data-collected", "module-not-measured"])
        self._module = ""
        self._tests: dict[str, dict[str, Any]] = {}
        self._shared: set[int] = set()
        self._coverage.start()
        # After the start: what these imports execute counts as executed by an import.
        self._hits = [_counters(script) for script in MODULES]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        module = item.nodeid.split("::", maxsplit=1)[0]
        if module != self._module:
            self._save()
            self._module, self._tests, self._shared = module, {}, set()
        self._take()
        began_s = time.process_time()
        test = self._tests[item.nodeid] = {"passed": True, "seconds": 0.0, "c": [], "python": {}}
        try:
            return (yield)
        finally:
            test["seconds"] = round(time.process_time() - began_s, 4)
            test["c"] = sorted(self._take() | self._shared)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        self._coverage.switch_context(item.nodeid + _SETUP)
        try:
            return (yield)
        finally:
            self._coverage.switch_context(item.nodeid)
            if len(self._tests) == 1:
                self._shared = self._take()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if report.outcome != "passed":
            self._tests[item.nodeid]["passed"] = False
        return report

    def pytest_sessionfinish(self) -> None:
        self._save()
        self._coverage.stop()

    def _take(self) -> set[int]:
        """Return the numbers of the statements executed since the last call."""
        found: set[int] = set()
        for counters in self._hits:
            found.update(np.flatnonzero(counters).tolist())
            counters[:] = 0
        return found

    def _save(self) -> None:
        """Write what the tests of the current module executed."""
        if not self._tests:
            return
        lines: dict[str, dict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        imported: dict[str, list[int]] = {}
        data = self._coverage.get_data()
        first = next(iter(self._tests)) + _SETUP
        for path in data.measured_files():
            file = str(Path(path).relative_to(self._root))
            by_line = data.contexts_by_lineno(path)
            imported[file] = sorted(line for line, contexts in by_line.items() if "" in contexts)
            for line, contexts in by_line.items():
                for context in contexts:
                    lines[context.removesuffix(_SETUP)][file].add(line)
                    if context == first:
                        for test in self._tests:
                            lines[test][file].add(line)
        for name, entry in self._tests.items():
            entry["python"] = {file: sorted(executed) for file, executed in lines[name].items()}
        target = self._folder / (self._module.replace("/", "-") + ".json")
        target.write_text(json.dumps({"imported": imported, "tests": self._tests}))


def _counters(script: str) -> npt.NDArray[np.uint8]:
    """Return the counters of the module that SCRIPT builds."""
    folder, _, name = script.removesuffix(".py").rpartition("/")
    module = import_module(f"{folder.replace('/', '.')}._{name.removeprefix('build_')}")
    count = int(os.environ["MUTATION_HITS"])
    library = ctypes.CDLL(str(module.__file__))
    counters = (ctypes.c_ubyte * count).in_dll(library, "mutation_hits")
    return np.frombuffer(memoryview(counters), dtype=np.uint8)


def pytest_configure(config: pytest.Config) -> None:
    folder = Path(os.environ["MUTATION_COLLECT"])
    folder.mkdir(parents=True, exist_ok=True)
    config.pluginmanager.register(Collector(folder), "mutation-coverage")
