"""The running machine: host, nodes and devices, time base, node recovery, emergency stop."""
