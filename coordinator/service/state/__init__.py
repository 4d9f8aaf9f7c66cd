"""What front ends watch: figures, log, toolpath, trace."""
