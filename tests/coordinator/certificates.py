"""Certificates for tests."""

import shutil
import subprocess
from pathlib import Path

import pytest


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """Return a certificate of 127.0.0.1 in FOLDER, and its key."""
    if (openssl := shutil.which("openssl")) is None:
        pytest.skip("openssl is not installed, which makes the certificate for this test")
    pem, key = folder / "cert.pem", folder / "key.pem"
    options = f"req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -out {pem} -keyout {key}"
    names = ["-subj", "/CN=machine", "-addext", "subjectAltName=IP:127.0.0.1"]
    subprocess.run([openssl, *options.split(), *names], check=True, capture_output=True)
    return pem, key
