"""What programs are made of and controlled by: macros, pause, virtual SD card, saved variables."""
