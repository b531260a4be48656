"""Logs as they were recorded, and the mapping by which they become trajectories.

Belongs here: one file per family of log formats, which gives signals with times of their own; the
mapping file, units, cutting and resampling. Not here: files that hold trajectories already (see
`data.io`). To add a format, write a module with a function `read(path, wanted, clock)` that yields
signals and add one entry to `catalog.LOGS`. Readers run in a process of their own with a limit of
memory, since the native code of a log's library may do anything on a damaged file.
"""
