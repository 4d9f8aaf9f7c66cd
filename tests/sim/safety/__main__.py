"""``python -m tests.sim.safety``."""

import sys

from tests.sim.safety.cases import main

sys.exit(main(sys.argv[1:]))
