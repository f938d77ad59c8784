"""A cache of bounded size: what was used longest ago is let go first."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class Cache(Generic[K, V]):
    """Things that are dear to make, by key. Not safe across threads.

    bound  what may be held: bytes where `size` tells them, else a number of things
    size   bytes of a thing; the one asked for last is held even where it passes the bound alone
    """

    def __init__(self, bound: int, size: Callable[[V], int] | None = None) -> None:
        self.held = 0
        self._bound, self._size = bound, size
        self._things: OrderedDict[K, V] = OrderedDict()

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The thing of a key, made unless it is held."""
        if key in self._things:
            self._things.move_to_end(key)
            return self._things[key]
        if self._size is None:  # room is made first, so that never more than the bound is there
            self._drop_oldest(self._bound - 1, left=0)
        made = self._things[key] = make()
        self.held += self._weight(made)
        self._drop_oldest(self._bound, left=1)
        return made

    def _drop_oldest(self, bound: int, left: int) -> None:
        while self.held > bound and len(self._things) > left:
            self.held -= self._weight(self._things.popitem(last=False)[1])

    def _weight(self, thing: V) -> int:
        return 1 if self._size is None else self._size(thing)
