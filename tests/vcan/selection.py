"""Which tests run on the kernel's CAN, and in which boot. A pytest plugin: ``-p tests.vcan.selection``.

Everything else runs in ``make pytest`` and would only cost time here.
"""

import pytest

LONG = (
    "test_lost_frames",
    "test_tools_through_python_cans_backend",
    "test_nodes_get_ids_and_answer_in_spite_of_lost_and_late_frames",
    "test_print_ends_where_the_plan_says",
    "test_full_interface_queue_costs_time_and_no_frame",
    "test_burst_arrives_complete_and_in_order_both_ways",
)
"""They come first, so that each kernel has its share of them."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--part",
        default="1/1",
        help="K/N: run each Nth test, from the Kth on: for N kernels side by side",
    )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    part, _, parts = config.getoption("--part").partition("/")
    found = sorted(filter(_is_on_the_kernels_can, items), key=_is_short)
    chosen = found[int(part) - 1 :: int(parts)]
    left = set(items) - set(chosen)
    config.hook.pytest_deselected(items=[item for item in items if item in left])
    items[:] = chosen


def _is_on_the_kernels_can(item: pytest.Item) -> bool:
    """Tell by the folder, or by a parameter's name."""
    return item.nodeid.startswith("tests/vcan/") or "socketcan" in item.name


def _is_short(item: pytest.Item) -> bool:
    return item.name.partition("[")[0] not in LONG
