"""Writes the JSON schemas of `monitor.toml` and of the registry's steps: python schemas.py."""

from __future__ import annotations

import json
from pathlib import Path

from retwin.monitor.registry import Step
from retwin.monitor.settings import MonitorSettings

DOCS = Path(__file__).parents[1]
SCHEMAS = {"monitor.schema.json": MonitorSettings, "registry.schema.json": Step}


def written(name: str) -> str:
    """The contents of a schema's file."""
    return json.dumps(SCHEMAS[name].model_json_schema(), indent=2) + "\n"


if __name__ == "__main__":
    for name in SCHEMAS:
        (DOCS / name).write_text(written(name), encoding="utf-8")
