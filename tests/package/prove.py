"""Proves what is shipped: a source distribution becomes a wheel, which is installed and prints far from here.

Usage: python -m tests.package.prove [--keep FOLDER] [PYTHON...]

PYTHONs are this one and one of every other release found on the PATH or below pyenv, unless some are named;
what could not build it is named and skipped. Debian's own is among them, which lacks later fixes of its
version. The first one builds the wheel from the source distribution, for all of them, since it is one of the
stable ABI. For each, a new virtual environment in a temporary folder gets that wheel, with its dependencies
from pip's index. There the demo prints a small program and has to end with its proof, and a machine that is
served over TLS has to answer. Exit status 1 when anything fails; the last words say what.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

from tests.coordinator.certificates import make_certificate
from tests.package.build import ROOT, setup
from tests.stages.processes import Command, own_port

NAMES: Final = tuple(f"python3.{minor}" for minor in range(11, 20))
PROGRAM: Final = """\
G28
G90
M82
G92 E0
G1 Z0.3 F600
G1 X20 Y20 F9000
G1 X40 Y20 E1 F3000
G1 X40 Y40 E2
G1 X20 Y40 E3
G1 X20 Y30 E4
G1 Z0.6 F600
"""
"""Every stepper of the demo machine moves; two seconds."""
DEMO: Final = ("--machine", "demo", "--json", "--gcode", "square.gcode")
PIP: Final = ("pip", "-q", "--disable-pip-version-check")
"""Of each environment: an old one does not run with a newer Python."""
PAGES: Final = "import coordinator.web.files as f; assert (f.FOLDER / 'index.html').is_file()"
VERSION: Final = "import sys; print('%d.%d.%d' % sys.version_info[:3])"
LOCATION: Final = "import coordinator; print(coordinator.__file__)"
TOKEN: Final = "t" * 32
AT_ONCE: Final = 4
"""Installations that are proved at the same time: each waits for an index, then prints in real time."""


class ProofError(Exception):
    """What is shipped does not work; the text says what was run and how it ended."""


def _environment() -> dict[str, str]:
    return {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }


def run(folder: Path, *words: str | Path, seconds: float = 600.0) -> str:
    """Return what the command WORDS prints, run in FOLDER without anything of this environment's Python."""
    ended = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=_environment(),
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    if ended.returncode != 0:
        command = " ".join(str(word) for word in words)
        raise ProofError(f"{command}: exit status {ended.returncode}\n{ended.stdout}{ended.stderr}")
    return ended.stdout


def interpreters(named: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the version and path of each Python: those NAMED, else one of each release from 3.11 on."""
    found = named or [sys.executable, *_installed()]
    seen: set[str] = set()
    for python in found:
        answer = subprocess.run([python, "-c", VERSION], capture_output=True, text=True, check=False)
        version = answer.stdout.strip()
        if answer.returncode != 0:  # such as a shim of pyenv for a version that is not selected
            if named:
                raise ProofError(f"{python} does not run: {answer.stderr.strip()}")
        elif version not in seen and re.fullmatch(r"3\.(1[1-9]|[2-9]\d)\.\d+", version):
            seen.add(version)
            yield version, python


def _installed() -> Iterator[str]:
    for name in NAMES:
        for folder in os.get_exec_path():
            if path := shutil.which(name, path=folder):
                yield path
    versions = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser() / "versions"
    yield from (str(path) for name in NAMES for path in sorted(versions.glob(f"*/bin/{name}")))


def missing(python: str) -> str:
    """Return in a sentence what PYTHON lacks to build the project; empty when it has all."""
    words = ["sh", str(ROOT / ".ci" / "prerequisites"), python]
    return subprocess.run(words, capture_output=True, text=True, check=False).stderr.strip()


def usable(named: list[str]) -> list[tuple[str, str]]:
    """Return the ``interpreters`` that can build the project; says what the others lack."""
    found = []
    for version, python in interpreters(named):
        lacking = python != sys.executable and not named and missing(python)
        if lacking:
            print(f"python {version}: skipped: {lacking}", flush=True)
        else:
            found.append((version, python))
    if not found:
        raise ProofError("none of these is a Python from 3.11 on; name one that is")
    return found


def environment(python: str, folder: Path) -> Path:
    """Return the folder of the commands of a new virtual environment for PYTHON, in FOLDER."""
    folder.mkdir()
    run(folder, python, "-m", "venv", folder / "venv")
    return folder / "venv" / "bin"


def build(archive: Path, python: str, folder: Path) -> tuple[Path, float]:
    """Return the wheel of the source distribution ARCHIVE, built in FOLDER, and the seconds it took."""
    commands = environment(python, folder)
    begun_s = time.monotonic()
    run(folder, commands / "python", "-m", *PIP, "wheel", "--no-deps", "--wheel-dir", folder, archive)
    (wheel,) = folder.glob("*.whl")
    return wheel, time.monotonic() - begun_s


def prove_tls(commands: Path, folder: Path, port: int) -> str:
    """Serve the demo's machine over TLS at PORT and ask for its state; return in a sentence how that went."""
    if shutil.which("openssl") is None:
        return "TLS not tried: openssl is missing"
    certificate, key = make_certificate(folder)
    token, tokens = folder / "token", folder / "tokens"
    for path, text in ((token, TOKEN), (tokens, f"admin me {TOKEN}\n")):
        path.touch(0o600)
        path.write_text(text, encoding="ascii")
    program, address = commands / "canductor", f"127.0.0.1:{port}"
    words = ("demo", "--machine", "demo", "--serve", "--ipc", folder / "ipc", "--tcp", address)
    secrets = ("--tokens", tokens, "--tls-certificate", certificate, "--tls-key", key)
    asked = ("status", "--at", f"tls://{address}", "--certificate", certificate, "--token-file", token)
    with Command(
        *words, *secrets, program=(str(program),), folder=folder, environment=_environment()
    ) as serving:
        serving.stdout.wait_for("ready")
        run(folder, program, *asked)
        serving.signal(signal.SIGINT)
        serving.end()
    return "answers over TLS"


def prove(wheel: Path, python: str, folder: Path, port: int) -> str:
    """Return in a sentence what was proved of WHEEL, installed for PYTHON in FOLDER; PORT is for it alone."""
    commands = environment(python, folder)
    run(folder, commands / "python", "-m", *PIP, "install", "--no-compile", wheel)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    where = Path(run(elsewhere, commands / "python", "-c", LOCATION).strip())
    if not where.is_relative_to(folder):
        raise ProofError(f"the installation imports {where}")
    run(elsewhere, commands / "python", "-W", "error", "-c", PAGES)
    run(elsewhere, commands / "canductor", "simulate", "--list")
    (elsewhere / "square.gcode").write_text(PROGRAM)
    shown = run(elsewhere, commands / "canductor", "demo", *DEMO, seconds=120)
    report = json.loads(shown.splitlines()[-1])
    if report.get("ok") is not True or not report.get("steps"):
        raise ProofError(f"the demo is not proved: {shown}")
    return f"demo PROVED, {report['steps']} steps; {prove_tls(commands, elsewhere, port)}"


def main() -> int:
    """Prove; print a line for each Python."""
    parser = argparse.ArgumentParser(description="Build, install elsewhere, print.")
    parser.add_argument("pythons", metavar="PYTHON", nargs="*", help="interpreter; default: all found")
    parser.add_argument("--keep", metavar="FOLDER", type=Path, help="copy the distributions there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="canductor-package-") as temporary:
        folder = Path(temporary)
        try:
            setup(folder, "sdist", "--formats=gztar", f"--dist-dir={folder}")
            (archive,) = folder.glob("*.tar.gz")
            pythons = usable(options.pythons)
            version, python = pythons[0]
            wheel, built_s = build(archive, python, folder / "build")
            print(f"python {version}: {wheel.name} built in {built_s:.0f} s", flush=True)
            with ThreadPoolExecutor(AT_ONCE) as pool:
                proofs = {
                    version: pool.submit(prove, wheel, python, folder / version, own_port(number))
                    for number, (version, python) in enumerate(pythons)
                }
                for version, proof in proofs.items():
                    print(f"python {version}: {proof.result()}", flush=True)
        except (ProofError, AssertionError, OSError, subprocess.SubprocessError) as error:
            print(f"package: {error}", file=sys.stderr)
            return 1
        if options.keep:
            options.keep.mkdir(parents=True, exist_ok=True)
            for path in (archive, *folder.glob("*/*.whl")):
                shutil.copy2(path, options.keep)
    return 0


if __name__ == "__main__":
    sys.exit(main())
