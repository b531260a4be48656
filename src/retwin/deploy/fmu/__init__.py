"""Twins as FMUs for co-simulation, with their source code and without Python.

Belongs here: the C text of an FMU, its description, and its file. Not here: simulation of FMUs,
which are twins (`retwin.twins.FMUTwin`).
"""

from __future__ import annotations
