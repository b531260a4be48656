"""Commands: samplers that draw them, and the range of values and frequencies that they contain.

Belongs here: distributions of commands. Not here: the choice of what to record next (see
`evaluation`).
"""
