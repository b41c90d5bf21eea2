"""The page on speed says what the schema and the FLOP count say, and the sums add up."""

from pathlib import Path

from benchmarks import arithmetic
from benchmarks.arithmetic import page, row_cost, store_arrays

PAGE = Path(__file__).resolve().parents[2] / "docs" / "speed.md"


def test_the_page_has_each_table_as_it_is_computed():
    written = PAGE.read_text(encoding="utf-8")
    assert [table for table in page().split("\n\n") if table not in written] == []


def test_bytes_follow_the_formulas_of_the_page():
    ticks = 3000
    parts = store_arrays(ticks, 49, 3, "float16", "float32")
    assert parts["vl/features"].data_bytes == ticks * 49 * 2048 * 2 // 3
    sensor = sum(spec.data_bytes for name, spec in parts.items() if name.startswith("sensor/"))
    assert sensor == ticks * 65 * (1026 * 4 + 8)
    state = sum(spec.data_bytes for name, spec in parts.items() if name.startswith("state/"))
    assert state == ticks * 10 * (12 * 4 + 8)


def test_the_ceiling_is_the_share_of_the_peak():
    row = next(line for line in arithmetic.ceiling_table().split("\n") if "| A100 |" in line)
    assert f"| {0.55 * 312e12 / row_cost(3).total():.1f} |" in row
