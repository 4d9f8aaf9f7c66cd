"""The packages with their extension modules built for another processor, as their builders declare them."""

import contextlib
import io
import os
import runpy
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from tests.arm.target import Target, run

ROOT: Final = Path(__file__).resolve().parents[2]
PACKAGES: Final = ("coordinator", "nodes", "canbus_tools")


def build_tree(target: Target) -> Path:
    """Return a folder with the Python packages, their modules built for TARGET."""
    tree = target.folder / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    left_out = shutil.ignore_patterns("__pycache__", "*.so", "*.[cho]")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tree / package, ignore=left_out)
    scripts = sorted(script for package in PACKAGES for script in (ROOT / package).rglob("build_*.py"))
    commands = [_command(target, script, tree) for script in scripts]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(lambda words: run(words, ROOT), commands))
    return tree


def _command(target: Target, script: Path, tree: Path) -> list[str]:
    """Return the command that compiles the extension module of SCRIPT into TREE."""
    builder = runpy.run_path(str(script))["ffibuilder"]
    module, _, _, options = builder._assigned_source
    generated = target.folder / "c" / f"{module}.c"
    generated.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.redirect_stdout(io.StringIO()):  # cffi says what it does
        builder.emit_c_code(str(generated))
    headers = target.root / "usr" / "include"
    included = [
        *options["include_dirs"],
        str(headers / "python3.11"),
        str(headers),  # pyconfig.h leads to the processor's own
    ]
    output = tree.joinpath(*module.split(".")).with_suffix(".abi3.so")
    words = [
        target.compiler,
        "-shared",
        "-fPIC",
        *options["extra_compile_args"],
        "-DPy_LIMITED_API=0x030b0000",
    ]
    words += [f"-I{folder}" for folder in included]
    words += [str(generated), *options["sources"], "-o", str(output)]
    return words + [f"-l{name}" for name in options["libraries"]]
