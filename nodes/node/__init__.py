"""One node over its life cycle: configuration, states, requests and replies, watchdog."""
