"""One node through its life: configuration, states, requests and replies, watchdog."""
