"""One file per format of logs: its signals, as they were recorded."""
