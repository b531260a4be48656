"""Twins from FMUs: the model description, the instance in a process of its own, and the twin.

Belongs here: import by FMI 2.0 and 3.0. Not here: the export of twins as FMUs (see `deploy`).
"""
