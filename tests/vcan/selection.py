"""Which tests run on the kernel's CAN, and in which boot. A pytest plugin: ``-p tests.vcan.selection``.

Everything else runs in ``make pytest`` and would only cost time here.
"""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--part",
        default="1/1",
        help="K/N: run each Nth test, from the Kth on: for N kernels side by side",
    )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    part, _, parts = config.getoption("--part").partition("/")
    chosen = [item for item in items if _is_on_the_kernels_can(item)][int(part) - 1 :: int(parts)]
    left = set(items) - set(chosen)
    config.hook.pytest_deselected(items=[item for item in items if item in left])
    items[:] = chosen


def _is_on_the_kernels_can(item: pytest.Item) -> bool:
    """Tell by the folder, or by a parameter's name."""
    return item.nodeid.startswith("tests/vcan/") or "socketcan" in item.name
