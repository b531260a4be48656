"""`monitor.toml`: the example of the documentation, its schema, and what is refused."""

from __future__ import annotations

import json
import runpy
import tomllib
from pathlib import Path

import jsonschema
import pytest

from retwin.errors import InputError
from retwin.monitor.settings import MqttSource, read_settings, secret
from retwin.monitor.store.audit import read_log, verify

DOCS = Path(__file__).parents[2] / "docs"
LEAST = """
store = "store"
[twins.incubator]
monitor = "watch"
[assets.line1]
twin = "incubator"
"""


def block(kind: str) -> str:
    text = (DOCS / "monitor.md").read_text("utf-8")
    return text.split(f"```{kind}\n")[1].split("```")[0]


def schema(name: str) -> dict:
    return json.loads((DOCS / name).read_text("utf-8"))


def test_the_example_is_read_and_follows_the_schema(tmp_path: Path) -> None:
    (tmp_path / "monitor.toml").write_text(block("toml"))
    found = read_settings(tmp_path / "monitor.toml")
    assert found.store == tmp_path / "store"
    assert found.twins["incubator"].monitor == tmp_path / "watch"
    assert found.sources[0].files == str(tmp_path / "logs/{asset}/*.csv")
    assert isinstance(found.sources[1], MqttSource)
    assert {each.type for each in found.sources} == {"folder", "mqtt", "opcua"}
    jsonschema.validate(tomllib.loads(block("toml")), schema("monitor.schema.json"))


def test_the_example_of_the_registry_is_a_log_that_follows_the_schema(tmp_path: Path) -> None:
    (tmp_path / "versions.jsonl").write_text(block("json"))
    entries = list(read_log(tmp_path / "versions.jsonl"))
    assert verify(entries).ok
    assert len(entries) == 2
    for each in entries:
        jsonschema.validate(each.data, schema("registry.schema.json"))


@pytest.mark.parametrize(
    "name", ["mapping.schema.json", "monitor.schema.json", "registry.schema.json"]
)
def test_the_schemas_are_those_of_the_models(name: str) -> None:
    written = runpy.run_path(str(DOCS / "scripts" / "schemas.py"))["written"]
    assert (DOCS / name).read_text("utf-8") == written(name), "run docs/scripts/schemas.py"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "store: expected a value, got none"),
        ("[", "expected a monitor.toml, got TOMLDecodeError"),
        (LEAST.replace('"store"', "3"), "store: expected"),
        (f"stor = 3\n{LEAST}", "stor: expected a known key"),
        (LEAST.replace('twin = "incubator"', 'twin = "x"'), r"a table \[twins.x\]"),
        (f"wait = 61.0\n{LEAST}", "wait: expected less than or equal to 60"),
        (f'url = "postgresql://me:word@db/x"\n{LEAST}', "a url without a password"),
        (f'{LEAST}[server]\nport = "1"\n', "server.port: expected a valid integer, got '1'"),
        (f'{LEAST}[[sources]]\ntype = "mqtt"\nhost = "h"\ntopic = "a/b"\n', "topic: expected"),
        (f'{LEAST}[[sources]]\ntype = "mqtt"\nhost = "h"\n', r"sources\[0\].topic: expected a val"),
        (f'{LEAST}[[sources]]\ntype = "folder"\nfiles = "*.csv"\n', "{asset} in files, or an"),
        (f'{LEAST}[[sources]]\ntype = "http"\n', "'folder', 'mqtt', 'opcua'"),
        (
            f'{LEAST}[[sources]]\ntype = "opcua"\nurl = "opc.tcp://h"\nnodes.line9 = {{}}\n',
            r"a table \[assets.line9\]",
        ),
        (
            f'{LEAST}[[sources]]\ntype = "opcua"\nurl = "opc.tcp://h"\nnodes.line1 = {{}}\n'
            'security = "Basic256Sha256"\n',
            "cert_file and key_file",
        ),
    ],
)
def test_what_is_wrong_is_named_with_its_key(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "monitor.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        read_settings(file)
    assert str(raised.value).startswith(str(file))
    assert "\n" not in str(raised.value)


def test_a_secret_is_in_a_file_or_in_the_environment(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "token").write_text("word\n")
    assert secret("token", "UNSET_BEFORE", tmp_path / "token") == "word"
    monkeypatch.setenv("SET_BEFORE", "other")
    assert secret("token", "SET_BEFORE") == "other"
    assert secret("token", None) is None
    with pytest.raises(InputError, match="UNSET_BEFORE: expected the token"):
        secret("token", "UNSET_BEFORE")
    with pytest.raises(InputError, match="none"):
        secret("token", None, tmp_path / "none")
