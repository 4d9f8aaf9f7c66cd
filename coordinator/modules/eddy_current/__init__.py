"""Probes that measure their height above metal, and the temperature of their coils."""
