"""The table of derivative terms that an integrator sums.

Adding a term: one file with its estimator and its `TERM` (`plan.term` says what that is), and one entry here. Planning,
pilot, command line and tests iterate over this table and know no term by name.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..boundary import chain, direct, indirect, primary
from ..interior import term as interior_term
from ..plan.term import Term

TERMS: list[Term] = [interior_term.TERM, primary.TERM, chain.TERM, direct.TERM, indirect.TERM]


@contextmanager
def registered(term: Term) -> Iterator[None]:
    """Integrators sum `term` as well, inside of a `with` block: for terms that live elsewhere, or on trial."""
    if any(term.name == other.name for other in TERMS):
        raise ValueError(f"there is a term called '{term.name}' already: give it another name")
    TERMS.append(term)
    try:
        yield
    finally:
        TERMS.remove(term)
