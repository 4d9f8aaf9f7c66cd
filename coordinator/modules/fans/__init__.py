"""Fans, by hand, automatic, or holding a temperature."""
