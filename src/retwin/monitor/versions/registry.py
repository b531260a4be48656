"""Versions of a twin: proposed, in the shadow of the active one, active, retired or rejected.

Every step is an entry of the store's log, and the log is the only place that holds the steps: what
is active is what its entries yield.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from retwin.checks import given, instance, require, whole
from retwin.errors import InputError
from retwin.monitor.store.store import Store
from retwin.monitor.versions.decision import Decision
from retwin.serialisation.files import refusing, sha256, write_atomically
from retwin.serialisation.sizes import Budget

State = Literal["proposed", "shadow", "active", "retired", "rejected"]
KIND = "version"
"""The kind of the registry's entries in the log."""
FOLDER = "versions"
"""The folder in that of the store, with one folder per content, named by its hash."""
BEFORE: Mapping[str, tuple[State, ...]] = {
    "shadow": ("proposed",),
    "promote": ("shadow",),
    "reject": ("proposed", "shadow"),
}
"""The states in which a version may be for a step."""
AFTER: Mapping[str, State] = {"shadow": "shadow", "promote": "active", "reject": "rejected"}
"""The state of a version after a step."""


@dataclass(frozen=True)
class Version:
    """A version of a twin.

    Attributes
    ----------
    number : int
        Its number, from 1.
    digest : str
        The SHA-256 of its folder, see `retwin.serialisation.files.sha256`.
    state : {"proposed", "shadow", "active", "retired", "rejected"}
        Where it is.
    reason : str
        Why it was proposed.
    reference : bool
        Whether it was the first active one, which stays beside all later ones unchanged, so that no
        sequence of updates absorbs a slow fault.

    """

    number: int
    digest: str
    state: State
    reason: str
    reference: bool = False


class Step(BaseModel):
    """The data of an entry of kind "version" in the log; docs/registry.schema.json is its schema.

    Attributes
    ----------
    twin : str
        The name of the twin.
    step : str
        What was done.
    version : int
        With which version; a rollback names the one that is active again.
    digest : str
        Of a proposed version, the SHA-256 of its folder, `versions/DIGEST` in that of the store.
    reason : str
        Why it was done.
    evidence : dict
        Of a promotion, but for the first one, the comparison with the active version.

    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    twin: str
    step: Literal["propose", "shadow", "promote", "reject", "rollback"]
    version: Annotated[int, Field(ge=1)]
    digest: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None
    reason: str = ""
    evidence: dict[str, Any] | None = None

    @model_validator(mode="after")
    def _proposed_by_its_digest(self) -> Step:
        if (self.step == "propose") != (self.digest is not None):
            raise ValueError("a digest is that of a proposed version")
        return self


class Registry:
    """The versions of one twin in a store.

    Parameters
    ----------
    store : Store
        Where folders and steps are kept.
    twin : str
        The name of the twin, as one store may hold several.

    """

    def __init__(self, store: Store, twin: str = "twin") -> None:
        self._store = instance("store", store, Store, remedy="open one with Store(folder)")
        self.twin = instance("twin", twin, str, remedy="give its name as text")

    def versions(self) -> list[Version]:
        """All versions in the order of their numbers."""
        return list(self._read()[0].values())

    @property
    def active(self) -> Version | None:
        """The version whose alarms count; None before the first promotion."""
        versions, history = self._read()
        return versions[history[-1]] if history else None

    @property
    def reference(self) -> Version | None:
        """The first version that was active; None before the first promotion."""
        return next((each for each in self.versions() if each.reference), None)

    def propose(self, folder: str | Path, reason: str) -> Version:
        """Copy the folder of a saved model into the store, as a new version.

        Hidden files are not copied. On return, copy and log are durable.

        Raises
        ------
        InputError
            There is no such folder, it contains a link or what is neither file nor folder, it is
            larger than the free disk permits, or it changed while it was copied.

        """
        instance("reason", reason, str, remedy="say why in a text")
        source = Path(folder)
        with self._store.lock:
            digest = self._copy(source)
            number = len(self._read()[0]) + 1
            self._log("propose", number, digest=digest, reason=reason)
        return Version(number, digest, "proposed", reason)

    def shadow(self, number: int) -> Version:
        """Let a proposed version predict beside the active one, without alarms that count."""
        return self._step("shadow", number)

    def reject(self, number: int, reason: str) -> Version:
        """Give up a version that is proposed or a shadow."""
        return self._step("reject", number, reason=reason)

    def promote(self, number: int, evidence: Decision | None = None) -> Version:
        """Make a version the active one; the former one is retired.

        Other shadows are proposed again, since they were compared with the former one.

        Parameters
        ----------
        number : int
            The version: a shadow, or, while none is active, a proposed one.
        evidence : Decision, optional
            What `retwin.monitor.decide` returned for this version and the active one. The first
            version needs none.

        Raises
        ------
        InputError
            The evidence is missing or against the version, or it is in another state.

        """
        with self._store.lock:
            if self.active is None:
                return self._step("promote", number, first=True)
            decision = instance("evidence", evidence, Decision, remedy="compare both with decide()")
            expected = "a difference in CRPS whose 95 % interval is above 0, and alarms as promised"
            got = decision.summary
            remedy = "keep the active version, or collect more samples"
            require(decision.better, "evidence", expected=expected, got=got, remedy=remedy)
            return self._step("promote", number, evidence=asdict(decision))

    def rollback(self, reason: str = "") -> Version:
        """Make the version active that was so before the active one, which is retired."""
        with self._store.lock:
            history = self._read()[1]
            expected, got = "a version that was active before", f"{len(history)} that was active"
            former = history[-2] if len(history) > 1 else None
            remedy = "propose and promote another version"
            number = given("rollback", former, expected, got=got, remedy=remedy)
            self.folder(number)
            self._log("rollback", number, reason=reason)
            return self._version(number)

    def folder(self, number: int) -> Path:
        """The folder of a version, after its bytes were compared with its hash; only read it.

        Raises
        ------
        InputError
            There is no such version, or its files were changed.

        """
        version = self._version(number)
        place = self._store.folder / FOLDER / version.digest
        expected, remedy = f"version {number} as it was proposed", "restore the store from a copy"
        with refusing(place, expected=expected, remedy=remedy):
            list(_files(place))
            found = sha256(place)
        require(
            found == version.digest, str(place), expected=expected, got="other bytes", remedy=remedy
        )
        return place

    def _version(self, number: int) -> Version:
        versions = self._read()[0]
        found = versions.get(whole("version", number, at_least=1))
        known = f"one of {', '.join(map(str, versions)) or 'none'}"
        return given("version", found, known, got=number, remedy="propose it first")

    def _step(self, step: str, number: int, *, first: bool = False, **more: Any) -> Version:
        with self._store.lock:
            version = self._version(number)
            allowed = BEFORE[step] + (("proposed",) if first else ())
            possible = version.state in allowed
            expected = f"one that is {' or '.join(allowed)}, to {step} it"
            got = f"one that is {version.state}"
            remedy = "see versions()"
            require(possible, f"version {number}", expected=expected, got=got, remedy=remedy)
            if AFTER[step] != "rejected":
                self.folder(number)
            self._log(step, number, **more)
            return self._version(number)

    def _log(self, step: str, number: int, **more: Any) -> None:
        data = {"twin": self.twin, "step": step, "version": number, **more}
        self._store.commit(entries=[(KIND, data)])

    def _read(self) -> tuple[dict[int, Version], list[int]]:
        """Versions by their numbers, and those that are or were active and not rolled back."""
        versions: dict[int, Version] = {}
        history: list[int] = []
        for entry in self._store.log(KIND):
            data = entry.data
            where = f"entry {entry.sequence} of the log"
            with refusing(where, expected="a step of the registry", remedy="verify the log"):
                if data["twin"] == self.twin:
                    _apply(Step.model_validate(data), versions, history)
        return versions, history

    def _copy(self, source: Path) -> str:
        """The hash of a folder, after it was copied under that name unless it was before."""
        refused = "a folder of files that can be read"
        with refusing(source, expected=refused, remedy="save the model again"):
            there = source.is_dir() and not source.is_symlink()
            files = list(_files(source)) if there else []
            wanted, got = "the folder of a saved model", f"{source}, which is empty or none"
            require(files, "folder", expected=wanted, got=got, remedy="save the model first")
            Budget("folder", disk=self._store.folder).take(sum(f.stat().st_size for f in files))
            digest = sha256(source)
            place = self._store.folder / FOLDER / digest
            if place.is_dir():
                if sha256(place) == digest:
                    return digest
                shutil.rmtree(place)  # damaged since: it is put in order by this copy
            with write_atomically(place, folder=True) as part:
                for file in files:
                    _copy_file(file, part / file.relative_to(source))
                for folder in (part, *(each for each in part.rglob("*") if each.is_dir())):
                    _flush(folder)
                expected = "a folder that does not change"
                got = f"{source}, which changed while it was copied"
                remedy = "propose it again"
                require(sha256(part) == digest, "folder", expected=expected, got=got, remedy=remedy)
        _flush(place.parent)
        _flush(self._store.folder)
        return digest


def damaged(store: Store) -> str:
    """The first version of any twin whose files were changed since it was proposed; "" for none."""
    twins = {str(entry.data.get("twin")) for entry in store.log(KIND)}
    for twin in sorted(twins):
        registry = Registry(store, twin)
        try:
            for version in registry.versions():
                registry.folder(version.number)
        except InputError as error:
            return f"twin {twin}: {error}"
    return ""


def _apply(taken: Step, versions: dict[int, Version], history: list[int]) -> None:
    """Apply a step of the log."""
    step, number = taken.step, taken.version
    if step == "propose":
        versions[number] = Version(number, str(taken.digest), "proposed", taken.reason)
        return
    if step in ("promote", "rollback"):
        if history:
            versions[history[-1]] = replace(versions[history[-1]], state="retired")
        for other, version in versions.items():
            if version.state == "shadow":
                versions[other] = replace(version, state="proposed")
    if step == "promote":
        reference = not history
        history.append(number)
        versions[number] = replace(versions[number], state="active", reference=reference)
    elif step == "rollback":
        history.pop()
        versions[history[-1]] = replace(versions[history[-1]], state="active")
    else:
        versions[number] = replace(versions[number], state=AFTER[step])


def _files(folder: Path) -> Iterator[Path]:
    """The files in a folder that are not hidden; what is neither file nor folder is refused."""
    for each in sorted(folder.iterdir()):
        if each.name.startswith("."):
            continue
        mode = each.lstat().st_mode
        plain = stat.S_ISDIR(mode) or stat.S_ISREG(mode)
        expected = "a folder of files, without links"
        got = f"{each.name[:80]!r}, which is a link or a device"
        remedy = "save the model again into a new folder"
        require(plain, "folder", expected=expected, got=got, remedy=remedy)
        if stat.S_ISDIR(mode):
            yield from _files(each)
        else:
            yield each


def _copy_file(source: Path, target: Path) -> None:
    """Copy a file's bytes to the disk, not through a link that has replaced it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    opened = os.open(source, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    with os.fdopen(opened, "rb") as read, target.open("wb") as written:
        shutil.copyfileobj(read, written)
        written.flush()
        os.fsync(written.fileno())


def _flush(folder: Path) -> None:
    """Flush the names in a folder to the disk, where folders can be opened."""
    if os.name == "posix":
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
