"""Builds what pyproject.toml cannot describe: C code, and the example machines inside the installed package.

A cffi module is found by its build script: any ``build_*.py`` in a package that defines ``ffibuilder``.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent
PACKAGES = ("nodes", "coordinator", "canbus_tools")
BUILD_MODULES = {("nodes.support", "native_build"), ("nodes.support", "link_sources")}
"""Modules that only the build scripts import."""
EXAMPLE_MACHINES = ("coordinator", "example_machines")
"""Where an installation has the files of config/."""


class BuildPython(build_py):
    """Copies config/ into the package, and leaves out the modules that only the build needs."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        return [
            (name, module, path)
            for name, module, path in super().find_package_modules(package, package_dir)
            if not module.startswith("build_") and (name, module) not in BUILD_MODULES
        ]

    def run(self) -> None:
        if (
            not self.editable_mode
        ):  # what an earlier build left, such as a module that is gone, would be shipped
            for package in PACKAGES:
                shutil.rmtree(Path(self.build_lib) / package, ignore_errors=True)
        super().run()
        if not self.editable_mode:
            for source, target in self._example_machines().items():
                self.mkpath(str(Path(target).parent))
                self.copy_file(source, target, preserve_mode=False)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        outputs: list[str] = super().get_outputs(include_bytecode)
        return outputs if self.editable_mode else [*outputs, *self._example_machines()]

    def _example_machines(self) -> dict[str, str]:
        """Return each file of config/ with its place in the build."""
        folder = Path(self.build_lib).joinpath(*EXAMPLE_MACHINES)
        files = sorted(path for path in Path("config").rglob("*") if path.is_file())
        return {str(path): str(folder / path.relative_to("config")) for path in files}


class BuildNative(build_ext):
    """Compiles the firmware of virtual nodes with the extension modules, on all cores."""

    def finalize_options(self) -> None:
        if self.inplace or self.editable_mode:  # one folder for both: what is compiled already stays
            self.build_temp = self.build_lib = str(ROOT / "build" / "native")
        super().finalize_options()
        self.parallel = self.parallel or True  # as many as there are cores

    def run(self) -> None:
        super().run()
        in_place = self.inplace or self.editable_mode
        bin_dir = (ROOT if in_place else Path(self.build_lib).absolute()) / "nodes" / "virtual" / "bin"
        options = [f"BIN_DIR={bin_dir}", f"PYTHON={sys.executable}"]
        subprocess.run(
            ["make", f"-j{os.cpu_count()}", "-C", str(ROOT / "firmware"), "linux", *options], check=True
        )


setup(
    cffi_modules=sorted(
        f"{script.relative_to(ROOT)}:ffibuilder"
        for package in PACKAGES
        for script in (ROOT / package).rglob("build_*.py")
    ),
    cmdclass={"build_ext": BuildNative, "build_py": BuildPython},
)
