"""What tests of several folders need."""

from pathlib import Path

import pytest

from tests.coordinator.certificates import make_certificate


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """Return a certificate of 127.0.0.1, and its key."""
    return make_certificate(tmp_path)
