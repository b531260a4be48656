"""`load_twin`: whatever an update saved, from its folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from retwin.errors import InputError
from retwin.serialisation.models import kind_of

if TYPE_CHECKING:
    from retwin.twins.twin import Twin
    from retwin.update.corrected import CorrectedTwin
    from retwin.update.dynamics import DynamicsTwin

IDENTIFICATION = "identification.json"
"""A file in the folder of an identification."""


def load_twin(folder: str | Path, twin: Twin | None = None) -> CorrectedTwin | DynamicsTwin:
    """The updated twin that `rt.fit`, `retwin fit` or the method `save` of a twin wrote.

    Parameters
    ----------
    folder : path
        The folder of the model.
    twin : Twin, optional
        The twin that it corrects, with its parameters free if they were identified. Only a model of
        a twin needs it that has neither equations nor a surrogate nor a case, such as a function.

    Returns
    -------
    CorrectedTwin or DynamicsTwin
        Both are a `Twin`. The twin of a case that has no equations is opened by the name of the
        case, which may run the user's code.

    Raises
    ------
    InputError
        The folder is missing, damaged, or holds something else.

    """
    from retwin.update.corrected import CorrectedTwin
    from retwin.update.dynamics import DynamicsTwin

    kind = kind_of(folder)
    if kind == DynamicsTwin.kind:
        return DynamicsTwin.load(folder)
    if kind == "corrected":
        return CorrectedTwin.load(folder, twin)
    got, remedy = f"a {kind}" if kind else "none", "give the folder that fit wrote"
    if (Path(folder) / IDENTIFICATION).is_file():
        got = "the folder of an identification"
        remedy = f"fit its twin first: retwin fit {Path(folder) / 'updated.toml'} --real LOG"
    expected = "the folder of a corrected model, with its model.json"
    raise InputError(str(folder), expected=expected, got=got, remedy=remedy)
