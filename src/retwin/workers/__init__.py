"""Work outside of the main thread: in threads, in processes, on a Dask cluster.

Belongs here: pools, their limits and their end with the program, and the processes of native code
that may crash, hang or take all memory. Not here: what is computed there.
"""
