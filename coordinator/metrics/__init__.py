"""What machines tell to Prometheus: the figures of the state tree (docs/metrics.md)."""
