"""Fitted models on disk: a folder of safetensors weights and a JSON description, never pickle."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retwin.checks import require
from retwin.serialisation import files
from retwin.serialisation.files import check_regular, read_json, recover, write_atomically
from retwin.serialisation.sizes import Budget

if TYPE_CHECKING:
    from torch import Tensor

SCHEMA = 1
"""The version of the layout of model folders."""
REMEDY = "give the folder of a saved model, or save it again"
BYTES_PER_NUMBER = 4
"""The size of a weight, in float32."""


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
    from safetensors.torch import save

    with write_atomically(folder, folder=True) as temporary:
        text = json.dumps({"schema": SCHEMA, "kind": kind, **about}, indent=1)
        (temporary / "model.json").write_text(text + "\n", encoding="utf-8")
        if weights:
            contiguous = {name: weight.contiguous() for name, weight in weights.items()}
            # Not `save_file`, whose files only their owner can read.
            (temporary / "weights.safetensors").write_bytes(save(contiguous))
        yield temporary


def save_model(
    folder: str | Path, kind: str, about: dict[str, Any], weights: dict[str, Tensor]
) -> None:
    """Write a model that has no further files, see `write_model`."""
    with write_model(folder, kind, about, weights):
        pass


def read_model(folder: str | Path, kind: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Description and weights of a model folder.

    Raises
    ------
    InputError
        The folder is missing, damaged, of another schema, larger than the free memory allows, or
        holds another kind of model.

    """
    from safetensors.torch import load_file

    folder = recover(folder)
    expected = f"a {kind} model (model.json and weights.safetensors)"
    with refusing(folder, expected=expected):
        about = read_json(folder / "model.json")
        file = check_regular(folder / "weights.safetensors")
        weights = {}
        if file.exists():
            weights = load_file(file)
    found = (about.get("schema"), about.get("kind")) if isinstance(about, dict) else (None, None)
    require(
        found == (SCHEMA, kind),
        str(folder),
        expected=f"a {kind} model of schema {SCHEMA}",
        got=f"kind {found[1]!r}, schema {found[0]!r}",
        remedy=f"{REMEDY}; rt.load_twin reads what `retwin fit` saved, of any kind",
    )
    return about, weights


@contextmanager
def refusing(folder: str | Path, *, expected: str, remedy: str = REMEDY) -> Iterator[None]:
    """Refuse a model folder for every exception in the block, see `files.refusing`.

    The block cannot allocate tensors that are larger than the free memory allows: a description
    states the sizes of networks before their weights are compared.
    """
    with files.refusing(folder, expected=expected, remedy=remedy), _limit_memory(str(folder)):
        yield


@contextmanager
def _limit_memory(where: str) -> Iterator[None]:
    """Refuse to make tensors in the block that take more memory than there is."""
    from torch.utils._python_dispatch import TorchDispatchMode

    budget = Budget(where)

    class Limit(TorchDispatchMode):
        @classmethod
        def _should_skip_dynamo(cls) -> bool:
            """False, since what torch wraps here imports its compiler, which takes a second."""
            return False

        def __torch_dispatch__(
            self, operator: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            if args and isinstance(args[0], list) and all(isinstance(n, int) for n in args[0]):
                budget.take(BYTES_PER_NUMBER * math.prod(args[0]))
            return operator(*args, **(kwargs or {}))

    with Limit():
        yield


def check_weights(right: object, expected: str, got: object = "others") -> None:
    """Require the arrays of a saved model to be of the shapes and values that it needs."""
    require(right, "weights", expected=expected, got=got, remedy=REMEDY)


def read_about(folder: str | Path, kind: str) -> dict[str, Any]:
    """The description of a model folder without its weights; raises as `read_model` does."""
    return read_model(folder, kind)[0]


def kind_of(folder: str | Path) -> str:
    """The kind in the model.json of a folder; "" if there is none."""
    try:
        about = read_json(recover(folder) / "model.json")
    except (OSError, ValueError):
        return ""
    return str(about.get("kind", "")) if isinstance(about, dict) else ""
