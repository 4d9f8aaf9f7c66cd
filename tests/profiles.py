"""Hypothesis profiles: ``ci`` draws the same examples in every run, ``full`` draws new and many more.

``make test`` uses ``ci``, so that it gives the same answer each time; ``make thorough`` runs
``pytest --hypothesis-profile full``. Neither limits how long an example takes: that only measures how busy
the computer is.
"""

from typing import Final

from hypothesis import settings

CI: Final = "ci"
FULL: Final = "full"
CI_EXAMPLES: Final = 40
"""Of a test that does not say how many it needs."""
FULL_FACTOR: Final = 20


def register() -> None:
    """Make both profiles known to Hypothesis and select ``ci``; pytest's option may select the other."""
    settings.register_profile(CI, max_examples=CI_EXAMPLES, deadline=None, derandomize=True, database=None)
    settings.register_profile(FULL, max_examples=CI_EXAMPLES * FULL_FACTOR, deadline=None, print_blob=True)
    settings.load_profile(CI)


def is_full() -> bool:
    """Return whether the profile is ``full``: tests may then take minutes."""
    return settings.get_current_profile_name() == FULL


def examples(count: int) -> int:
    """Return how many examples a test draws that draws COUNT in profile ``ci``; for ``max_examples``."""
    return count * FULL_FACTOR if is_full() else count
