"""Processes for native code of others, which may crash, hang or take all memory.

Belongs here: such a process and its limits, pools of them, and the reading of files in one. Not
here: the pools of retwin's own work (see `processes`), and what is computed there.
"""
