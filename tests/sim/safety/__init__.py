"""What must switch heaters and motors off: every case on a simulated machine, judged by its pins."""
