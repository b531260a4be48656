"""Work outside of the main thread: threads, processes, a Dask cluster, and what may crash.

Belongs here: pools, their time limits and their end with the program, and the process in which the
libraries of foreign files run. Not here: what is computed there.
"""
