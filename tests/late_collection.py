"""A plugin of pytest: garbage is collected rarely, so that much of it dies at once, and in another order."""

import gc

gc.set_threshold(50_000, 20, 50)
