"""Builds what is written in C: every cffi module and the virtual nodes' firmware.

A cffi module is found by its build script: any ``build_*.py`` in a package that defines ``ffibuilder``.
"""

import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).parent
PACKAGES = ("nodes", "coordinator", "canbus_tools")


class BuildNative(build_ext):
    """Compiles the firmware of virtual nodes beside the extension modules."""

    def run(self) -> None:
        super().run()
        inplace = self.inplace or self.editable_mode
        bin_dir = (ROOT if inplace else Path(self.build_lib).absolute()) / "nodes" / "virtual" / "bin"
        options = [f"BIN_DIR={bin_dir}", f"PYTHON={sys.executable}"]
        subprocess.run(["make", "-C", str(ROOT / "firmware"), "linux", *options], check=True)


setup(
    cffi_modules=sorted(
        f"{script.relative_to(ROOT)}:ffibuilder"
        for package in PACKAGES
        for script in (ROOT / package).rglob("build_*.py")
    ),
    cmdclass={"build_ext": BuildNative},
)
