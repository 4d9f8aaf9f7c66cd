"""What a machine has besides motion: heaters, fans, macros. One small file each; base.py is the seam."""
