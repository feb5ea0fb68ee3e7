"""What ``copy`` and ``pickle`` give of the objects that users hold (docs/decisions/095-users-hands.md)."""

from __future__ import annotations

import copy
from typing import ClassVar, NoReturn, Self


class CopiedWhole:
    """``copy.copy`` gives what ``copy.deepcopy`` gives: a copy that shares no state with the original."""

    def __copy__(self) -> Self:
        return copy.deepcopy(self)


class NotCopied:
    """Copies and pickles are refused, because the object holds something that has no copy."""

    instead: ClassVar[str]
    """Why, and what to do instead."""

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise TypeError(f"{type(self).__name__} cannot be copied or pickled: {self.instead}")
