"""`monitor.toml`: which machines are watched, by which twins, and where their samples come from.

No secret is in the file: a password or a token is read from a variable of the environment or from a
file of its own. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict, ValidationInfo, model_validator

from retwin.checks import require
from retwin.serialisation.configs import Part, settings_of
from retwin.serialisation.files import refusing

PORT = 65535
"""The largest number of a port."""


def _beside(path: Path | str, info: ValidationInfo) -> Path:
    return Path(info.context or ".") / path


def _case(name: str | None, info: ValidationInfo) -> str | None:
    return str(_beside(Path(name), info)) if name and name.endswith(".toml") else name


Beside = Annotated[Path, Strict(False), AfterValidator(_beside)]
"""A path relative to the file."""
Port = Annotated[int, Field(ge=1, le=PORT)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=200)]


class TwinSettings(Part):
    """A twin: the monitor that watches its machines."""

    monitor: Beside
    """Folder of `retwin monitor fit`. It is the first version; a changed one is only proposed."""
    case: Annotated[str | None, AfterValidator(_case)] = None
    """Its case, if another than the twin was fitted for: a name, case.toml or module:object."""
    limits: dict[Name, Annotated[list[float], Field(min_length=2, max_length=2)]] = Field(
        default={}
    )
    """The smallest and the largest possible value of channels, such as { air = [-40, 150] }: a
    value outside of them is reported as impossible and not used."""


class AssetSettings(Part):
    """A machine."""

    twin: Name
    """The name of its twin, one of [twins]."""


class FolderSource(Part):
    """Files in a folder: tables (CSV, Parquet) that appear and grow, or trajectories."""

    type: Literal["folder"]
    files: Annotated[str, AfterValidator(lambda files, info: str(_beside(files, info)))]
    """Pattern of the files, such as "logs/{asset}/*.csv"; {asset} stands for each machine."""
    asset: Name | None = None
    """The machine, where the pattern has no {asset}."""
    columns: dict[str, str | list[str]] = Field(default={})
    """Column of each channel, or several, of which it is the mean; by default as the case has them,
    else the names of the channels."""
    time: str | None = None
    """Column of the times; by default that of the case, else "time"."""
    unit: Literal["s", "ms", "us", "ns", "iso"] | None = None
    """Unit of the times, from 1970 on, or ISO 8601; by default that of the case, else "s"."""
    every: Seconds = 1.0
    """Interval in s at which the folder is read."""
    settle: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 2.0
    """Time in s without a change after which a file of trajectories is complete."""
    mapping: Beside | None = None
    """File mapping.toml of `retwin data map`: which columns are which channels, with their units
    and clock, instead of `columns`, `time` and `unit`; and how logs become trajectories."""

    @model_validator(mode="after")
    def _names_one_asset(self) -> FolderSource:
        if ("{asset}" in self.files) == (self.asset is not None):
            raise ValueError("either {asset} in files, or an asset")
        if self.mapping is not None and (self.columns or self.time or self.unit):
            raise ValueError("either a mapping, or columns, time and unit")
        return self


class MqttSource(Part):
    """Topics of an MQTT broker (version 5), at least once: acknowledged when they are stored."""

    type: Literal["mqtt"]
    host: str
    """The broker."""
    port: Port | None = None
    """Its port; by default 1883, with TLS 8883."""
    topic: Annotated[str, Field(pattern=r"^[^#+]*\{asset\}[^#+{}]*$")]
    """Topic of each machine, such as "plant/{asset}/samples"."""
    client_id: Name = "retwin-monitor"
    """Name by which the broker keeps messages while the monitor is away: one per monitor."""
    keep: Annotated[int, Field(ge=0, le=2**32 - 2)] = 86400
    """Time in s for which the broker keeps them."""
    user: str | None = None
    """User name."""
    password_env: str | None = None
    """Variable of the environment with the password."""
    tls: bool = False
    """Whether the connection is encrypted."""
    ca_file: Beside | None = None
    """Certificates of the authorities that are trusted; by default those of the system."""
    cert_file: Beside | None = None
    """Certificate of the monitor, where the broker wants one."""
    key_file: Beside | None = None
    """Its private key."""


class OpcUaSource(Part):
    """A subscription to nodes of an OPC UA server."""

    type: Literal["opcua"]
    url: Annotated[str, Field(pattern=r"^opc\.tcp://[^@]+$")]
    """Address of the server, opc.tcp://HOST:PORT/PATH."""
    nodes: Annotated[dict[Name, dict[str, str]], Field(min_length=1)]
    """By machine and channel, the node, such as "ns=2;s=line1.T1"."""
    interval: Seconds | None = None
    """Interval in s at which the server sends; by default the sample period, at most 1 s."""
    user: str | None = None
    """User name."""
    password_env: str | None = None
    """Variable of the environment with the password."""
    security: Literal["Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss"] | None = None
    """Policy by which messages are signed and encrypted; it needs both files."""
    cert_file: Beside | None = None
    """Certificate of the monitor."""
    key_file: Beside | None = None
    """Its private key."""
    server_file: Beside | None = None
    """Certificate of the server; without it, any server at the address is trusted."""

    @model_validator(mode="after")
    def _complete(self) -> OpcUaSource:
        files = (self.cert_file, self.key_file)
        if any((each is None) == (self.security is not None) for each in files):
            raise ValueError("cert_file and key_file together with security")
        if self.server_file is not None and self.security is None:
            raise ValueError("server_file only with security")
        return self


TOKEN = "RETWIN_MONITOR_TOKEN"
"""The variable of the environment with the token, where no other is named."""


class ServerSettings(Part):
    """The page and the interface for other programs."""

    host: str = "127.0.0.1"
    """Address that it listens on; the default is reached from this machine alone."""
    port: Annotated[int, Field(ge=0, le=PORT)] = 8710
    """Its port; 0 for any that is free."""
    hosts: list[str] = Field(default=[])
    """Names of this machine by which others reach it, where it listens on more than loopback."""
    token_env: str | None = None
    """Variable of the environment with the token that writing needs; by default
    RETWIN_MONITOR_TOKEN, without which the page is read only."""
    token_file: Beside | None = None
    """File with the token instead."""


Kind = Literal["alarm", "remark", "cause", "end", "void", "event", "version"]
"""Kinds of entries of the log of which a line is reported."""
Span = Annotated[str, Field(pattern=r"^([01]\d|2[0-3]):[0-5]\d-([01]\d|2[0-3]):[0-5]\d$")]


class NotifySettings(Part):
    """Who hears of events: once each, and later where it cannot be reached at once."""

    url_env: str | None = None
    """Variable of the environment with the address as Apprise writes it: mailto://, slack://,
    json:// for a webhook, and others."""
    file: Beside | None = None
    """File to which a line of JSON is appended instead."""
    kinds: list[Kind] = Field(default=["alarm", "cause", "end", "void"])
    """What is sent: the begin of an event, its cause and each change of it, its end, and that the
    promise is void."""
    assets: list[Name] = Field(default=[])
    """The machines; by default all."""
    quiet: list[Span] = Field(default=[])
    """Times of the day, such as "22:00-06:00", between which nothing is sent, for maintenance."""

    @model_validator(mode="after")
    def _one_channel(self) -> NotifySettings:
        if (self.url_env is None) == (self.file is None):
            raise ValueError("either url_env or file")
        return self


Source = Annotated[FolderSource | MqttSource | OpcUaSource, Field(discriminator="type")]


class MonitorSettings(Part):
    """The keys of a monitor.toml; see docs/monitor.md."""

    store: Beside
    """Folder of the store, which is made."""
    url: str = ""
    """PostgreSQL database instead of SQLite, postgresql://user@host/name; without a password, which
    PGPASSWORD or a .pgpass file holds."""
    max_samples: Annotated[int, Field(ge=1)] | None = None
    """Samples of each machine that are kept; by default all."""
    wait: Annotated[float, Field(gt=0, le=60)] | None = None
    """Time in s for which a hole waits for its sample; by default two sample periods."""
    ahead: Seconds = 60.0
    """Time in s by which a sample may be ahead of this machine's clock."""
    twins: Annotated[dict[Name, TwinSettings], Field(min_length=1)]
    """The twins by their names."""
    assets: Annotated[dict[Name, AssetSettings], Field(min_length=1)]
    """The machines by their names."""
    sources: list[Source] = Field(default=[])
    """Where samples come from, besides those that programs post."""
    notify: dict[Name, NotifySettings] = Field(default={})
    """Who hears of events, by their names."""
    server: ServerSettings | None = None
    """The page; none without this table."""

    @model_validator(mode="after")
    def _names_exist(self) -> MonitorSettings:
        for name, asset in self.assets.items():
            if asset.twin not in self.twins:
                raise ValueError(f"a table [twins.{asset.twin}], which the asset {name} names")
        named = [("[notify]", name) for each in self.notify.values() for name in each.assets]
        for source in self.sources:
            asked = getattr(source, "asset", None)
            known = getattr(source, "nodes", [asked] if asked else [])
            named += [("a source", name) for name in known]
        for who, name in named:
            if name not in self.assets:
                raise ValueError(f"a table [assets.{name}], which {who} names")
        if re.match(r"[^/]*//[^/@]*:[^/@]*@", self.url):
            raise ValueError("a url without a password")
        return self


def read_settings(path: str | Path) -> MonitorSettings:
    """The settings that a monitor.toml holds.

    Raises
    ------
    InputError
        The file is no TOML, a key is unknown or missing, or a value is refused. The message names
        the file and the key.

    """
    return settings_of(
        MonitorSettings,
        Path(path),
        expected="a monitor.toml",
        remedy="see docs/monitor.md for what it holds",
    )


def secret(what: str, env: str | None, file: Path | None = None) -> str | None:
    """A password or token from a file or a variable of the environment; None if neither is named.

    Raises
    ------
    InputError
        The file cannot be read, or what is named is not there or empty.

    """
    if file is not None:
        with refusing(file, expected=f"a file with the {what}", remedy="make it, for you alone"):
            value = file.read_text("utf-8").strip()
    elif env is not None:
        value = os.environ.get(env, "")
    else:
        return None
    place = str(file or f"the variable {env}")
    remedy = f"put the {what} there" + f", as in export {env}=…" * (file is None)
    require(value, place, expected=f"the {what}", got="nothing", remedy=remedy)
    return value
