"""What the monitor remembers, in SQL: samples, states of streams, and the log with its audit.

Belongs here: what is written to a database or read from one. Not here: versions of twins, which
are folders (see `versions`).
"""
