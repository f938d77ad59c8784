"""The bounded cache: what is held, what is made again, and how much at most."""

import pytest

from catalog.cache import Cache


def test_what_is_held_is_not_made_again_and_what_was_used_longest_ago_goes() -> None:
    made: list[str] = []
    cache: Cache[str, str] = Cache(2)

    def get(key: str) -> str:
        return cache.get(key, lambda: made.append(key) or key.upper())  # type: ignore[func-returns-value]

    assert [get(key) for key in "abab"] == ["A", "B", "A", "B"]
    assert made == ["a", "b"]
    get("a")
    get("c")  # lets b go, which was used before a
    get("a")
    assert made == ["a", "b", "c"]
    get("b")
    assert made == ["a", "b", "c", "b"]


def test_bytes_stay_within_the_bound_but_for_one_thing_that_is_larger() -> None:
    cache: Cache[int, bytes] = Cache(100, len)
    for key in range(10):
        cache.get(key, lambda: bytes(30))
        assert cache.held <= 100
    assert cache.held == 90
    assert len(cache.get(10, lambda: bytes(500))) == 500
    assert cache.held == 500
    cache.get(11, lambda: bytes(1))
    assert cache.held == 1


def test_old_things_are_let_go_before_a_new_one_is_made() -> None:
    cache: Cache[int, int] = Cache(2)
    for key in range(5):
        assert cache.get(key, lambda: cache.held) == min(key, 1)


def test_a_thing_that_could_not_be_made_is_asked_for_again() -> None:
    cache: Cache[str, int] = Cache(3, lambda _: 1)
    with pytest.raises(ZeroDivisionError):
        cache.get("a", lambda: 1 // 0)
    assert cache.held == 0
    assert cache.get("a", lambda: 7) == 7
