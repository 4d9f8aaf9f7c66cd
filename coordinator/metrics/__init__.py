"""What Prometheus reads of a machine: the figures of the state tree (docs/metrics.md)."""
