"""`Dynamics`: settings of the discrepancy inside state equations, and what is known of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from retwin.checks import instance, one_of, require, whole
from retwin.update.dynamics.discrepancy.library import Library
from retwin.update.dynamics.discrepancy.network import TanhNetwork

__all__ = ["Dynamics"]


@dataclass(frozen=True)
class Dynamics:
    """Settings of the discrepancy inside state equations.

    Parameters
    ----------
    library : Library, optional
        Terms of which the discrepancy of each corrected equation is a weighted sum, at most: the
        constant alone and monomials of low degree alone are tried too.
    states : sequence of str
        The states whose equations are corrected; by default all whose equation is no definition,
        such as position' = velocity.
    folds : int, default 10
        Parts of the calibration record, each made of blocks of all trajectories, that are held out
        in turn to choose the form and to calibrate bands.
    network : TanhNetwork, optional
        A network in place of the terms, by default none. With a library too, both are tried, and
        the network is taken where it predicts held-out samples better beyond chance.
    memory : bool, default True
        Whether a hidden state that follows a corrected one slowly, such as a wall that takes up
        heat, is tried beside the linear terms of the library (`Memory`), unless more is known of
        the structure.
    depends : mapping of str to sequence of str
        Per corrected state, the states and commands on which its discrepancy may depend ("command
        NAME" for a command with the name of a state); by default those of the equation itself, and
        monomials of all, up to the second degree, where they predict nearly all held-out parts
        better and nothing else is known.
    monotone : mapping of str to mapping of str to int
        Per corrected state, the variables in which its discrepancy is monotone: 1 where it is
        non-decreasing, -1 where it is non-increasing, whatever the other variables are.
    held : bool, default False
        Whether the parameters of the twin keep their values, and with them their meaning: the
        discrepancy is what they leave. By default they are estimated together with it.
    passive : sequence of str
        Corrected states x whose discrepancy is non-increasing in x, and 0 where x is 0: so
        delta x <= 0, as with friction, and it never adds to the energy x^2 / 2.

    """

    library: Library | None = Library()  # noqa: RUF009 - frozen
    states: Sequence[str] = ()
    folds: int = 10
    network: TanhNetwork | None = None
    memory: bool = True
    depends: Mapping[str, Sequence[str]] = field(default_factory=dict)
    monotone: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    passive: Sequence[str] = ()
    held: bool = False

    def __post_init__(self) -> None:
        for name, kind in (("library", Library), ("network", TanhNetwork)):
            if getattr(self, name) is not None:
                instance(name, getattr(self, name), kind, remedy=f"give {kind.__name__}(...)")
        stated = self.library is not None or self.network is not None
        expected = "a library, a network, or both"
        remedy = "give Library(...) or network=TanhNetwork(...)"
        require(stated, "library", expected=expected, got="neither", remedy=remedy)
        for name in ("states", "passive"):
            given = getattr(self, name)
            distinct = not isinstance(given, str) and len(set(given)) == len(given)
            expected = "different names of states"
            got = repr(given)
            require(distinct, name, expected=expected, got=got, remedy="give each once, in a tuple")
            object.__setattr__(self, name, tuple(given))
        whole("folds", self.folds, at_least=2)
        one_of("memory", self.memory, (True, False))
        one_of("held", self.held, (True, False))
        for state, variables in self.depends.items():
            listed = not isinstance(variables, str) and len(variables) > 0
            expected = "names of variables for each state"
            got = f"{variables!r} for {state}"
            remedy = 'give them in a tuple, such as {"velocity": ("velocity",)}'
            require(listed, "depends", expected=expected, got=got, remedy=remedy)
        for state, signs in self.monotone.items():
            for sign in signs.values():
                one_of("monotone", sign, (1, -1))
            both = state in self.passive and set(signs) - {state}
            consistent = not both and not (state in self.passive and signs.get(state) == 1)
            expected = f"nothing for {state}, which is passive: non-increasing in {state} alone"
            remedy = "name it in one of monotone and passive"
            require(consistent, "monotone", expected=expected, got=", ".join(signs), remedy=remedy)

    @property
    def forms(self) -> Iterator[Library | TanhNetwork]:
        """The forms that are tried, each once."""
        libraries = [*self.library.nested()] if self.library else [Library(0, (), False)]
        yield from libraries
        if self.network is not None:
            yield self.network

    def remembers(self, form: Library | TanhNetwork) -> bool:
        """Whether a memory is tried beside a form."""
        return self.memory and not self.known and isinstance(form, Library) and form.linear

    @property
    def known(self) -> bool:
        """Whether something is known of the structure of the discrepancy."""
        return bool(self.depends or self.monotone or self.passive)

    def signs(self, state: str, variables: Sequence[str]) -> list[int]:
        """Per variable of a state equation, the sign of the slope of its discrepancy, or 0."""
        known = dict(self.monotone.get(state, {}))
        if state in self.passive:
            known[state] = -1
        for name in known:
            one_of("monotone", name, variables)
        return [known.get(name, 0) for name in variables]
