# SPDX-License-Identifier: Apache-2.0
"""A change, and how hypothesis makes many of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st


@dataclass(frozen=True)
class Edit:
    """One change of a message or of a file.

    Attributes:
        kind: what is done, a key of the kinds of the module that does it.
        where: to which of the parts that it fits, modulo their number.
        value: with which value.
    """

    kind: str
    where: int = 0
    value: Any = None


def with_values(where: st.SearchStrategy[int], **kinds: Sequence[Any]) -> st.SearchStrategy[Edit]:
    """Return a strategy of changes of some kinds, each with the values that it may have."""
    return st.one_of(
        *(
            st.builds(Edit, st.just(kind), where, st.sampled_from(values))
            for kind, values in kinds.items()
        )
    )


def exploring(examples: int, **own: Any) -> settings:
    """Return settings by which so many examples are made, no matter how long one takes."""
    return settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=False,
        print_blob=True,
        report_multiple_bugs=False,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
        **own,
    )
