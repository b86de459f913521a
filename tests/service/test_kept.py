"""Bytes that are kept as long as there is room."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from service.runtime.kept import KeptBytes


def test_what_was_used_least_lately_goes_first_and_what_has_no_room_is_not_kept() -> None:
    kept = KeptBytes(10)
    kept.keep("a", b"aaaa")
    kept.keep("b", b"bbbb")
    assert kept.find("a") == b"aaaa"
    kept.keep("c", b"cccc")
    assert (kept.find("a"), kept.find("b"), kept.find("c")) == (b"aaaa", None, b"cccc")
    kept.keep("d", b"d" * 11)
    assert kept.find("d") is None


@given(st.lists(st.tuples(st.integers(0, 5), st.binary(max_size=8)), max_size=60))
def test_a_key_has_what_was_kept_last_and_all_of_them_the_room(steps: list[tuple[int, bytes]]) -> None:
    kept, latest = KeptBytes(16), dict[int, bytes]()
    for key, data in steps:
        kept.keep(key, data)
        latest[key] = data
        assert kept.find(key) == data
    found = {key: kept.find(key) for key in latest}
    assert all(data in (None, latest[key]) for key, data in found.items())
    assert sum(len(data) for data in found.values() if data is not None) <= 16
