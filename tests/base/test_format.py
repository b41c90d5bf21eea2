"""How bytes and seconds are said, everywhere the same."""

import pytest

from pipeline.base.text import as_yaml, duration, size


@pytest.mark.parametrize(
    ("count", "said"),
    [
        (0, "0 B"),
        (1023, "1023 B"),
        (2**10, "1 KiB"),
        (2**20 - 2**9, "1024 KiB"),
        (2**20, "1.0 MiB"),
        (9.6 * 2**20, "9.6 MiB"),
        (2**30, "1.0 GiB"),
        (1.5 * 2**40, "1.5 TiB"),
    ],
)
def test_bytes(count: float, said: str) -> None:
    assert size(count) == said


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0, "0 s"),
        (0.0123, "0.0123 s"),
        (5.345, "5.34 s"),
        (119, "119 s"),
        (120, "2.0 min"),
        (330, "5.5 min"),
        (7200, "2.0 h"),
        (3600 * 1447.2, "1,447.2 h"),
    ],
)
def test_seconds(seconds: float, said: str) -> None:
    assert duration(seconds) == said


def test_documents_keep_their_order_and_what_is_flat_stands_in_one_line() -> None:
    slots = [{"layer": -1, "cell": (0, 1)}, {"name": "바늘", "of": None}]
    written = as_yaml({"b": {"list": list(range(99))}, "a": slots, "no": {}})
    first, numbers, *rest = written.splitlines()
    assert (first, numbers[:16], len(numbers)) == ("b:", "  list: [0, 1, 2", 394)
    assert rest == ["a:", "- layer: -1", "  cell: [0, 1]", "- {name: 바늘, of: null}", "'no': {}"]
