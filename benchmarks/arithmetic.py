"""The tables of docs/speed.md, from the schema and the FLOP count: nothing here is measured.

python -c "from benchmarks.arithmetic import page; print(page())"
"""

from collections.abc import Sequence

from benchmarks.flops import PEAK_TFLOPS, RowCost
from benchmarks.real_shape import real_config
from pipeline.store import Sizes, arrays
from pipeline.store.schema import ArraySpec

ACTION_HZ, REUSE = 10, 3
SENSOR_HZ, SENSOR_CHANNELS = 650, 1026
STATE_HZ, STATE_DIM, ACTION_DIM = 100, 12, 7
DIM = 2048
"""Width of the 3B model's hidden states."""
EPISODE_TICKS, EPISODE_TEXT_BYTES = 300, 300
IMAGE_SIZE, TEXT_TOKENS = (364, 644), 40
MFU = 0.55

_GRID_SLOTS = 16
"""Of a view."""


def page() -> str:
    """Every table, in the order of the page."""
    return "\n\n".join(table() for table in (ceiling_table, bytes_table, whole_table))


def ceiling_table() -> str:
    """Rows a second at the aim of `MFU` of each GPU's peak; computed, not measured."""
    costs = [row_cost(views).total() for views in (3, 5)]
    rows = [
        [name, f"{tera}", *(f"{MFU * tera * 1e12 / cost:.1f}" for cost in costs)]
        for name, tera in PEAK_TFLOPS.items()
    ]
    return _table(["GPU", "peak TFLOP/s", "rows/s, 3 views", "rows/s, 5 views"], rows)


def row_cost(views: int) -> RowCost:
    """Of the 3B model at 360 x 640."""
    return RowCost.of(real_config(), IMAGE_SIZE, views, TEXT_TOKENS)


def bytes_table() -> str:
    """Bytes of each part of a store by the amount of ticks."""
    stores = {dtype: store_arrays(10**6, 1, 3, dtype, dtype) for dtype in ("float16", "float32")}
    slots = {"mean": 1, "mean + grid, 3 views": 49, "mean + grid, 5 views": 81}
    rows: list[list[str]] = []
    for name, count in slots.items():
        assert count == 1 or (count - 1) % _GRID_SLOTS == 0
        parts = store_arrays(10**6, count, 3, "float16", "float16")
        rows.append(_bytes_row(f"features: {name}, float16", parts["vl/features"].data_bytes))
    for dtype, parts in stores.items():
        rows.append(_bytes_row(f"sensor, {dtype}", _sum(parts, "sensor/")))
    rows.append(_bytes_row("state, float32", _sum(stores["float16"], "state/")))
    rest = sum(spec.data_bytes for spec in stores["float16"].values())
    rest -= sum(_sum(stores["float16"], part) for part in ("vl/features", "sensor/", "state/"))
    rows.append(_bytes_row("all else, 1 slot of 3 views (ticks, keys, checksums, times)", rest))
    return _table(["part", "a tick", "an hour", "1 M ticks"], rows)


def whole_table() -> str:
    """Bytes of two whole stores, the smallest and the largest that are likely."""
    rows: list[list[str]] = []
    for name, slots, dtype in (
        ("small: `mean`, sensor and features float16", 1, "float16"),
        ("large: `mean, grid` of 5 views, sensor and features float32", 81, "float32"),
    ):
        parts = store_arrays(10**6, slots, 5, dtype, dtype)
        rows.append(_bytes_row(name, sum(spec.data_bytes for spec in parts.values())))
    return _table(["store", "a tick", "an hour", "1 M ticks"], rows)


def store_arrays(
    ticks: int, slots: int, views: int, features_dtype: str, sensor_dtype: str
) -> dict[str, ArraySpec]:
    """The arrays of a store of this many ticks."""
    episodes = ticks // EPISODE_TICKS
    sizes = Sizes(
        episode=episodes,
        tick=ticks,
        vl_row=-(-ticks // REUSE),
        sensor_reading=ticks * SENSOR_HZ // ACTION_HZ,
        state_reading=ticks * STATE_HZ // ACTION_HZ,
        byte=episodes * EPISODE_TEXT_BYTES,
        slot=slots,
        dim=DIM,
        view=views,
        action_dim=ACTION_DIM,
        channel=SENSOR_CHANNELS,
        state_dim=STATE_DIM,
    )
    return arrays(sizes, features_dtype, sensor_dtype)


def _sum(specs: dict[str, ArraySpec], prefix: str) -> int:
    return sum(spec.data_bytes for name, spec in specs.items() if name.startswith(prefix))


def _bytes_row(name: str, of_a_million: int) -> list[str]:
    a_tick = of_a_million / 10**6
    amounts = (a_tick * ticks for ticks in (3600 * ACTION_HZ, 10**6))
    return [name, f"{a_tick:,.0f} B", *map(_size, amounts)]


def _size(count: float) -> str:
    for unit in ("kB", "MB", "GB", "TB"):
        count /= 1000
        if count < 1000:
            return f"{count:.3g} {unit}"
    return f"{count / 1000:,.3g} PB"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
