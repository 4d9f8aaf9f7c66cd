"""The processors: their compiler, their emulator, and a Debian root folder with Python for them."""

import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

SUITE: Final = "bookworm"
MIRROR: Final = "http://deb.debian.org/debian"
PACKAGES: Final = (
    "libpython3.11-dev",
    "python3",
    "python3-aiohttp",
    "python3-can",
    "python3-cffi-backend",
    "python3-jinja2",
    "python3-msgpack",
    "python3-numpy",
    "python3-rich",
    "python3-serial",
)
"""What planning and simulation import, and Python's headers."""


class ArmError(Exception):
    """Something cannot be built, run, or gives another result; one sentence."""


@dataclass(frozen=True, slots=True)
class Target:
    """A processor."""

    name: str
    """As QEMU has it."""
    debian: str
    triplet: str
    folder: Path
    """Where everything for it is built."""

    @property
    def compiler(self) -> str:
        return f"{self.triplet}-gcc"

    @property
    def root(self) -> Path:
        """The root folder of a Debian of this processor."""
        return self.folder / "root"

    @property
    def emulator(self) -> tuple[str, ...]:
        """The words before a program of this processor."""
        libraries = self.root / "usr" / "lib" / self.triplet
        # Debian's choice of libblas and liblapack is a link that a package's script would make.
        paths = ":".join(str(libraries / name) for name in ("blas", "lapack"))
        return (f"qemu-{self.name}-static", "-L", str(self.root), "-E", f"LD_LIBRARY_PATH={paths}")

    def python(self, tree: Path, *words: str | Path) -> list[str]:
        """Return the command that runs this processor's Python on the packages in TREE."""
        home = self.root / "usr"
        path = f"{tree}:{home / 'lib' / 'python3' / 'dist-packages'}"
        program = home / "bin" / "python3.11"
        set_ = ("-E", f"PYTHONHOME={home}", "-E", f"PYTHONPATH={path}", "-E", "PYTHONDONTWRITEBYTECODE=1")
        return [*self.emulator, *set_, str(program), "-P", *map(str, words)]

    def make_root(self) -> None:
        """Unpack the packages, unless they are there; nothing of them is run for it."""
        if self.root.is_dir():
            return
        partly = self.root.with_suffix(".partly")
        shutil.rmtree(partly, ignore_errors=True)
        partly.parent.mkdir(parents=True, exist_ok=True)
        packages = f"--include={','.join(PACKAGES)}"
        extract = ("mmdebstrap", "--variant=extract", "--skip=output/dev", "--format=directory")
        run([*extract, f"--architectures={self.debian}", packages, SUITE, str(partly), MIRROR])
        partly.rename(self.root)


def targets(folder: Path) -> Iterator[Target]:
    """Yield the processors of small computers: 64 and 32 bits."""
    yield Target("aarch64", "arm64", "aarch64-linux-gnu", folder / "aarch64")
    yield Target("arm", "armhf", "arm-linux-gnueabihf", folder / "arm")


def missing_packages(wanted: Sequence[Target]) -> list[str]:
    """Return the Debian packages that this computer lacks for WANTED."""
    needed = {"mmdebstrap": "mmdebstrap"}
    for target in wanted:
        needed[target.compiler] = f"gcc-{target.triplet} libc6-dev-{target.debian}-cross"
        needed[target.emulator[0]] = "qemu-user-static"
    return sorted({package for program, package in needed.items() if shutil.which(program) is None})


def run(words: Sequence[str], folder: Path | None = None) -> str:
    """Return what the command WORDS prints; raises ArmError when it fails."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        last = "\n".join((done.stdout + done.stderr).splitlines()[-20:])
        raise ArmError(f"{' '.join(words)}: exit status {done.returncode}\n{last}")
    return done.stdout
