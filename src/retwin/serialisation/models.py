"""Fitted models on disk: a folder of safetensors weights and a JSON description, never pickle."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retwin.checks import require
from retwin.errors import InputError
from retwin.serialisation.files import write_atomically

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["kind_of", "read_about", "read_model", "refusing", "write_model"]

SCHEMA = 1
"""The version of the layout of model folders."""
REMEDY = "give the folder of a saved model, or save it again"


@contextmanager
def write_model(
    folder: str | Path, kind: str, about: dict[str, Any], weights: dict[str, Tensor]
) -> Iterator[Path]:
    """Write `folder`/model.json and `folder`/weights.safetensors, whole or not at all.

    Yields the temporary folder, to which more files can be written.

    Parameters
    ----------
    folder : path
        The folder to make or replace.
    kind : str
        The kind of the model, which `read_model` checks.
    about : dict
        Its description, as JSON values.
    weights : dict of str to torch.Tensor
        Its parameters; no file is written for none.

    Raises
    ------
    InputError
        See `write_atomically`.

    """
    from safetensors.torch import save_file

    with write_atomically(folder) as temporary:
        temporary.mkdir()
        text = json.dumps({"schema": SCHEMA, "kind": kind, **about}, indent=1)
        (temporary / "model.json").write_text(text + "\n", encoding="utf-8")
        if weights:
            contiguous = {name: weight.contiguous() for name, weight in weights.items()}
            save_file(contiguous, temporary / "weights.safetensors")
        yield temporary


def read_model(folder: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Description and weights of a model folder.

    Raises
    ------
    InputError
        The folder is missing, damaged, of another schema, or holds another kind of model.

    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    folder = Path(folder)
    try:
        about = json.loads((folder / "model.json").read_text(encoding="utf-8"))
        file = folder / "weights.safetensors"
        weights = load_file(file) if file.exists() else {}
    except (OSError, ValueError, SafetensorError) as error:
        raise InputError(
            str(folder),
            expected=f"a {kind} model (model.json and weights.safetensors)",
            got=f"{type(error).__name__}: {str(error).splitlines()[0]}",
            remedy=REMEDY,
        ) from None
    found = (about.get("schema"), about.get("kind")) if isinstance(about, dict) else (None, None)
    require(
        found == (SCHEMA, kind),
        str(folder),
        expected=f"a {kind} model of schema {SCHEMA}",
        got=f"kind {found[1]!r}, schema {found[0]!r}",
        remedy=REMEDY,
    )
    return about, weights


@contextmanager
def refusing(folder: str | Path, *, expected: str, remedy: str = REMEDY) -> Iterator[None]:
    """Turn every exception that reading untrusted contents raises into an InputError.

    A sealed folder is untrusted too although its seal is intact, since anyone can seal a folder.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:100]}"
        raise InputError(str(folder), expected=expected, got=got, remedy=remedy) from None


def read_about(folder: str | Path, kind: str) -> dict[str, Any]:
    """The description of a model folder without its weights; raises as `read_model` does."""
    return read_model(folder, kind)[0]


def kind_of(folder: str | Path) -> str:
    """The kind in the model.json of a folder; "" if there is none."""
    try:
        about = json.loads((Path(folder) / "model.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return ""
    return str(about.get("kind", "")) if isinstance(about, dict) else ""
