"""Jobs: the job folder, journal, recovery, jobs that are fed by a client."""
