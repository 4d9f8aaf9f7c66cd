from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.stage import Hardware, hardware


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Hardware]:
    with hardware(tmp_path) as started:
        yield started
