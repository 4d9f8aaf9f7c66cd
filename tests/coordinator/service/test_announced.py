"""A port that others can reach is announced without being asked for; there may be no network to do so."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.coordinator.certificates import make_certificate
from tests.stages.printer_text import DEMO_CFG, write
from tests.stages.processes import CANDUCTOR, END_S, ROOT


def need_own_networks() -> None:
    """Skip the test where nobody may make networks of his own, without any interface that is up."""
    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed: it makes a computer without networks")
    if subprocess.run(["unshare", "-rn", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets nobody make networks of his own (unshare -rn)")


def test_a_computer_without_networks_says_so(tmp_path: Path) -> None:
    need_own_networks()
    pem, key = make_certificate(tmp_path)
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    config = write(tmp_path, DEMO_CFG.replace("can0", f"virtual:{tmp_path}/none"))
    words = ["run", config, "--ipc", tmp_path / "s", "--tcp", "0.0.0.0:7125", "--tokens", tokens]
    words += ["--tls-certificate", pem, "--tls-key", key]
    command = subprocess.Popen(
        ["unshare", "-rn", *CANDUCTOR, *map(str, words)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert command.stdout is not None
        said = next((line for line in command.stdout if "to announce" in line), "")
    finally:
        command.terminate()
        command.communicate(timeout=END_S)
    assert said == "there is no network to announce the machine on; it will be announced when there is one\n"
    assert command.returncode == 0
