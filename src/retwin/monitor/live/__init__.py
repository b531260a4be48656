"""Machines that run: their samples as they arrive, what is found in them, and when it is stored.

Belongs here: the state of each watched machine between two commits. Not here: where samples come
from (see `sources`) and who is shown them (see `server`).
"""
