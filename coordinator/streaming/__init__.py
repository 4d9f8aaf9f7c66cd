"""From a program to the nodes in real time: pipeline, worker thread, streamer, events, standstill tasks."""
