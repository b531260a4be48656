"""Trajectories of commands and outputs, their segments, and the files they come from.

Belongs here: the data types, file formats, downloads. Not here: anything that simulates, learns or
scores.
"""

from __future__ import annotations

from retwin._lazy import homes, names

_HOME = homes(
    {
        "download": "cache_folder fetch",
        "io": "DataCase load save",
        "io.zarr_folder": "read_zarr",
        "logs.mapping": "Mapping read_mapping",
        "logs.proposal": "propose_mapping",
        "provenance": "Provenance Sampling",
        "quality.agreement": "explained_shares",
        "quality.check": "Checked check_records",
        "quality.finding": "Finding summarise",
        "segments": "Segments",
        "trajectories": "Channels HEALTHY Trajectories UNLABELLED",
    }
)

__getattr__, __dir__, __all__ = names(__name__, _HOME)
