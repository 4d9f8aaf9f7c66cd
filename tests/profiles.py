"""Hypothesis profiles: ``ci`` draws the same examples in every run, ``full`` draws new and many more.

``make test`` uses ``ci``, so that it gives the same answer each time; ``make thorough`` runs
``pytest --hypothesis-profile full``. Neither limits how long an example takes: that only measures how busy
the computer is.
"""

from typing import Final

from hypothesis import settings

CI: Final = "ci"
FULL: Final = "full"
FULL_FACTOR: Final = 20


def register() -> None:
    """Make both profiles known to Hypothesis and select ``ci``; pytest's option may select the other."""
    settings.register_profile(CI, deadline=None, derandomize=True, database=None)
    settings.register_profile(FULL, deadline=None, print_blob=True)
    settings.load_profile(CI)


def examples(count: int) -> int:
    """Return how many examples a test draws that draws COUNT in profile ``ci``; for ``max_examples``."""
    return count * FULL_FACTOR if settings.get_current_profile_name() == FULL else count
