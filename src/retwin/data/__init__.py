"""Trajectories of commands and outputs, their segments, and the files they come from.

Belongs here: the data types, file formats, downloads. Not here: anything that simulates, learns or
scores.
"""

from __future__ import annotations

from retwin._lazy import names

_HOME = {
    "Channels": "trajectories",
    "DataCase": "io",
    "HEALTHY": "trajectories",
    "Mapping": "logs.mapping",
    "Provenance": "provenance",
    "Sampling": "provenance",
    "Segments": "segments",
    "Trajectories": "trajectories",
    "UNLABELLED": "trajectories",
    "cache_folder": "download",
    "fetch": "download",
    "load": "io",
    "propose_mapping": "logs.proposal",
    "read_mapping": "logs.mapping",
    "read_zarr": "io.zarr_folder",
    "save": "io",
}

__getattr__, __dir__, __all__ = names(__name__, _HOME)
