"""A copy of the project that stays, in which single files change and only what they touch is compiled.

Objects are kept: of a change in a .c file one object is compiled and its module linked again, of one in a
header all objects that include it.
"""

import json
import marshal
import math
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final

from tests.mutation.areas import MODULES, ROOT
from tests.mutation.mutation import Mutation

FOLDER: Final = ROOT / "build" / "mutation"
COPIED: Final = (
    *("coordinator", "nodes", "firmware", "config", "canbus_tools", "tests", "docs", "bench"),
    *("pyproject.toml", "setup.py", "README.md"),
)
LEFT_OUT: Final = ("__pycache__", ".mypy_cache", ".pytest_cache", ".ruff_cache", ".hypothesis")
BUILT: Final = (".so", ".o", ".d", ".pyc")
FILE_MAX_BYTES: Final = 1 << 30

_RECIPE: Final = """
import importlib, json, sys
extension = importlib.import_module(sys.argv[1]).ffibuilder.distutils_extension("build/native", verbose=False)
print(json.dumps([extension.name, list(extension.sources), list(extension.include_dirs),
                  list(extension.extra_compile_args), list(extension.libraries)]))
"""
_C_TEST_FLAGS: Final = (
    *("-std=gnu11", "-g", "-O1", "-w", "-fno-omit-frame-pointer", "-fsanitize=address,undefined"),
    *("-fno-sanitize-recover=all", "-I.", "-Ifirmware", "-Ibuild/ctest/generated", "-pthread"),
)


class BuildError(Exception):
    """What was compiled is no C, or does not fit together."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a command ended."""

    status: int | None
    """Exit status; None when it took longer than it may."""
    output: str


@dataclass(frozen=True, slots=True)
class Program:
    """Something that is linked: an extension module or a C test program."""

    name: str
    output: str
    sources: tuple[str, ...]
    compile_flags: tuple[str, ...]
    link_flags: tuple[str, ...]


class ProjectCopy:
    """The project in build/mutation/NAME."""

    def __init__(self, name: str) -> None:
        self.folder = FOLDER / name
        self._extra: tuple[str, ...] = ()
        self._defines: tuple[str, ...] = ()
        self.modules: list[Program] = []
        self.c_tests: list[Program] = []

    # ------------------------------------------------------------------------------------------- contents

    def update(self, changed: Mapping[str, bytes] | None = None) -> None:
        """Make the copy equal to the project, but for the files CHANGED; what is equal keeps its time."""
        shared, link = ROOT.parent / "shared", FOLDER / "shared"
        if shared.is_dir() and not link.exists():  # tests look for it beside the project
            FOLDER.mkdir(parents=True, exist_ok=True)
            link.symlink_to(shared)
        wanted: set[Path] = set()
        for part in COPIED:
            top = ROOT / part
            for path in sorted(top.rglob("*")) if top.is_dir() else [top]:
                relative = path.relative_to(ROOT)
                if path.is_file() and path.suffix not in BUILT and not set(LEFT_OUT) & set(relative.parts):
                    wanted.add(relative)
                    self.write(str(relative), (changed or {}).get(str(relative), path.read_bytes()))
                    (self.folder / relative).chmod(path.stat().st_mode)
        # Extension modules that are not mutated come compiled.
        for path in ROOT.rglob("*.so"):
            relative = path.relative_to(ROOT)
            if relative.parts[0] in COPIED and not (self.folder / relative).exists():
                shutil.copy2(path, self.folder / relative)
        for part in COPIED:
            for path in (self.folder / part).rglob("*.*"):
                is_source = path.suffix == ".py" or (path.suffix in {".c", ".h"} and path.name[0] != "_")
                if is_source and path.relative_to(self.folder) not in wanted:
                    path.unlink()

    def write(self, file: str, content: bytes) -> None:
        """Write FILE unless it reads CONTENT."""
        path = self.folder / file
        if path.exists() and path.read_bytes() == content:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)

    def read(self, file: str) -> bytes:
        """Return what FILE reads."""
        return (self.folder / file).read_bytes()

    # -------------------------------------------------------------------------------------------- running

    def run(
        self,
        command: Sequence[str],
        *,
        timeout_s: float = 600.0,
        cpu_s: float = 3600.0,
        environment: Mapping[str, str] | None = None,
    ) -> Outcome:
        """Run COMMAND in the copy; ends it and all that it started after TIMEOUT_S.

        CPU_S of computing end it, too: unlike TIMEOUT_S that does not depend on how busy the computer is.
        """
        variables = {**os.environ, "PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
        # A file: what outlives the command could hold a pipe open.
        with tempfile.TemporaryFile() as output:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env={**variables, **(environment or {})},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=partial(_limit, math.ceil(cpu_s)),  # noqa: PLW1509 - takes no lock
            )
            try:
                status: int | None = process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                status = None
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            output.seek(0)
            text = output.read().decode(errors="replace")
        return Outcome(None if status in {-signal.SIGXCPU, -signal.SIGKILL} else status, text)

    # ------------------------------------------------------------------------------------------- building

    def prepare(self, flags: Sequence[str] = ("-O2", "-g0", "-w"), extra_sources: Sequence[str] = ()) -> None:
        """Find out how modules and C tests are built, and build the modules.

        FLAGS are added to the modules' own, definitions among them to those of C tests, too; EXTRA_SOURCES
        are part of each module and C test.
        """
        self._extra = tuple(extra_sources)
        self._defines = tuple(flag for flag in flags if flag.startswith("-D"))
        for script in MODULES:
            name = script.removesuffix(".py").replace("/", ".")
            done = self.run([sys.executable, "-c", _RECIPE, name])
            if done.status:
                raise BuildError(done.output)
            module, sources, includes, arguments, libraries = json.loads(done.output.splitlines()[-1])
            includes = [*includes, sysconfig.get_path("include")]
            self.modules.append(
                Program(
                    module,
                    module.replace(".", "/") + ".abi3.so",
                    (*sources, *self._extra),
                    ("-fPIC", *(f"-I{folder}" for folder in includes), *arguments, *flags),
                    ("-shared", "-pthread", *(f"-l{library}" for library in libraries)),
                )
            )
        self.c_tests = [self._c_test(path) for path in sorted((self.folder / "tests").rglob("test_*.c"))]
        for program in self.modules:
            self.build(program)

    def _c_test(self, path: Path) -> Program:
        file = path.relative_to(self.folder)
        sources = [str(file)]
        for line in path.read_text().splitlines():
            if line.startswith("// sources: "):
                for pattern in line.split()[2:]:
                    sources += sorted(str(p.relative_to(self.folder)) for p in self.folder.glob(pattern))
        output = f"build/ctest/{file.with_suffix('')}"
        return Program(
            str(file), output, (*sources, *self._extra), (*_C_TEST_FLAGS, *self._defines), ("-lm",)
        )

    def build(self, program: Program) -> None:
        """Compile what of PROGRAM is out of date, and link it; raises BuildError."""
        objects = [self._object(program, source) for source in program.sources]
        for source, target in zip(program.sources, objects, strict=True):
            if self._outdated(target):
                self._compile(program, source, target)
        output = self.folder / program.output
        if output.exists() and all(o.stat().st_mtime_ns <= output.stat().st_mtime_ns for o in objects):
            return
        output.parent.mkdir(parents=True, exist_ok=True)
        # A new file: a process that has the old one mapped keeps it.
        output.unlink(missing_ok=True)
        self._gcc(program, [*map(str, objects), "-o", str(output), *program.link_flags])

    @contextmanager
    def planted(self, mutation: Mutation, c_tests: Sequence[Program] = ()) -> Iterator[bool]:
        """Make the change, with the modules that it touches compiled; take it back at the end.

        Gives whether the change makes no difference to any compiled object. Of C_TESTS, which must be built,
        the objects are set aside, so that build() makes those of the changed source. Raises BuildError when
        the changed file does not compile.
        """
        path = self.folder / mutation.file
        original, status = path.read_bytes(), path.stat()
        programs = [*self.modules, *c_tests]
        kept: list[Path] = []
        try:
            path.write_bytes(mutation.applied(original))
            if mutation.is_c:
                users = self._users(programs, path)
                touched = [(*objects, self.folder / program.output) for program, objects in users]
                kept += [_keep(target) for target in dict.fromkeys(chain.from_iterable(touched))]
                modules = [(program, objects) for program, objects in users if program in self.modules]
                for program, _ in modules:
                    self.build(program)
                changed = {target for _, objects in modules for target in objects}
                yield bool(changed) and all(_same_content(target) for target in changed)
            else:
                yield _same_code(original, path.read_bytes())
        finally:
            path.write_bytes(original)
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
            for target in kept:
                target.unlink(missing_ok=True)
                if _interjection(target).exists():
                    _interjection(target).rename(target)

    def _users(self, programs: Sequence[Program], path: Path) -> list[tuple[Program, list[Path]]]:
        """Return which of PROGRAMS contain PATH, each with the objects made of it; they must be built."""
        found = []
        for program in programs:
            targets = (self._object(program, source) for source in program.sources)
            objects = [target for target in targets if path in self._dependencies(target)]
            if objects:
                found.append((program, objects))
        return found

    def _object(self, program: Program, source: str) -> Path:
        kind = program.name if program in self.modules else "ctest"
        return (self.folder / "build" / "objects" / kind / source).with_suffix(".o")

    def _dependencies(self, target: Path) -> list[Path]:
        listed = shlex.split(target.with_suffix(".d").read_text().replace("\\\n", " "))[1:]
        return [self.folder / path for path in listed]

    def _outdated(self, target: Path) -> bool:
        if not target.exists() or not target.with_suffix(".d").exists():
            return True
        built = target.stat().st_mtime_ns
        return any(not p.exists() or p.stat().st_mtime_ns > built for p in self._dependencies(target))

    def _compile(self, program: Program, source: str, target: Path) -> None:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        options = ["-MMD", "-MF", str(target.with_suffix(".d")), "-c", source, "-o", str(target)]
        self._gcc(program, options)

    def _gcc(self, program: Program, options: Sequence[str]) -> None:
        done = self.run(["gcc", *program.compile_flags, *options])
        if done.status:
            raise BuildError(done.output)


def _interjection(target: Path) -> Path:
    return target.with_name(target.name + ".base")


def _keep(target: Path) -> Path:
    """Set TARGET aside, so that it can be compared and put back."""
    if target.exists():
        target.rename(_interjection(target))
    return target


def _same_content(target: Path) -> bool:
    return _interjection(target).exists() and _interjection(target).read_bytes() == target.read_bytes()


def _same_code(original: bytes, changed: bytes) -> bool:
    return marshal.dumps(compile(original, "", "exec")) == marshal.dumps(compile(changed, "", "exec"))


def _limit(cpu_s: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_MAX_BYTES, FILE_MAX_BYTES))
