"""Commands that the machine follows in place of those that it was given, inferred from outputs.

Delays, offsets and missed segments of commands, their features by condition, and the search.
"""
