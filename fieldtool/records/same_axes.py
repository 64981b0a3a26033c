"""Whether two things speak of the same axes: names, kinds and order."""

from collections.abc import Sequence
from itertools import zip_longest
from typing import Protocol


class NamedAxis(Protocol):
    """An axis of a model, a recording or a machine profile."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def kind(self) -> str:
        """Rotary or linear."""


def axes_differ(found: Sequence[NamedAxis], whose: str, needed: Sequence[NamedAxis]) -> str:
    """Return where axes differ from those that are needed, as the end of a sentence; empty: nowhere.

    Parameters
    ----------
    found
        Axes of what the sentence begins with.
    whose
        What the needed axes are those of, such as ``the recording``.
    needed
        Axes that were to be found.
    """
    here, there = ([f"{axis.name} ({axis.kind})" for axis in axes] for axes in (found, needed))
    for k, (one, other) in enumerate(zip_longest(here, there, fillvalue="missing"), start=1):
        if one != other:
            return (
                f"has the axes {', '.join(here)}, {whose} has {', '.join(there)}: axis {k} is "
                f"{one} here, {other} there. Give both the same names and kinds in the same order"
            )
    return ""
