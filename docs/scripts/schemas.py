"""Writes the JSON schemas of `monitor.toml`, `mapping.toml` and the registry's steps."""

from __future__ import annotations

import json
from pathlib import Path

from retwin.data.logs.mapping import Mapping
from retwin.monitor.settings import MonitorSettings
from retwin.monitor.versions.registry import Step

DOCS = Path(__file__).parents[1]
SCHEMAS = {
    "mapping.schema.json": Mapping,
    "monitor.schema.json": MonitorSettings,
    "registry.schema.json": Step,
}


def written(name: str) -> str:
    """The contents of a schema's file."""
    return json.dumps(SCHEMAS[name].model_json_schema(), indent=2) + "\n"


if __name__ == "__main__":
    for name in SCHEMAS:
        (DOCS / name).write_text(written(name), encoding="utf-8")
