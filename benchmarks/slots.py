"""What slots and storage dtypes cost: stage one's speed against the mean alone, and bytes a row.

    python -m benchmarks.slots [--rows N] [--quick]

Every contender fills a store of its own with the same recordings, the model loaded beforehand; all
frames differ. Then a whole store of tokens of random content is made and sealed, whose rows are
wide: its speed bounds extraction where the model is faster. Then numbers of int8 and float8 are
made again, against the copy of as many numbers in float32. Prints one JSON line.
"""

import shutil
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import torch

from benchmarks.stage_one import StageOne
from benchmarks.stores import write_store
from benchmarks.timing import arguments, at_least, race, report
from benchmarks.workload import Workload, params_of, write_recordings
from pipeline.base.digests import ContentDigests
from pipeline.base.packing import pack, unpack
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from pipeline.vlm.qwen import FrozenVLM

GRID: dict[str, Any] = {"pooling": ["mean", "grid"]}
TOKENS: dict[str, Any] = {"pooling": ["tokens"]}
CONTENDERS: dict[str, tuple[dict[str, Any], str]] = {
    "mean": ({"pooling": ["mean"]}, "float32"),
    "mean, grid": (GRID, "float32"),
    "tokens": (TOKENS, "float32"),
    "tokens, float16": (TOKENS, "float16"),
    "tokens, float8": (TOKENS, "float8"),
    "tokens, int8": (TOKENS, "int8"),
    "tokens of four layers": (TOKENS | {"layers": [0, 1, 2, 3]}, "float32"),
    "tokens of the vision tower": (TOKENS | {"layers": ["vision"]}, "float32"),
}
_DIM, _SLOTS = 2048, 48
_CELLS = (13, 69)
"""Rows and columns of 897 tokens, those of three views of 364 x 644 pixels."""


def main() -> None:
    """Race, and print the line."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--rows", type=int, default=150, help="VL rows that a store has")
    wanted = parser.parse_args()
    rows, rounds, slots = (4, 1, 2) if wanted.quick else (wanted.rows, wanted.rounds or 5, _SLOTS)
    names = ["mean", "tokens, int8"] if wanted.quick else [*CONTENDERS]
    with tempfile.TemporaryDirectory() as place, ExitStack() as stack:
        folder = Path(place)
        write_recordings(folder, rows)
        write_demo_checkpoint(folder / "vlm")
        runs = {name: _stage_one(folder, name, rows, stack) for name in names}
        raced = race(
            {name: run.run_every_frame for name, run in runs.items()},
            rounds=rounds,
            warmup=0 if wanted.quick else 1,
            before={name: run.prepare for name, run in runs.items()},
        )
        ratios = raced.ratios("mean")
        row_bytes = {name: run.row_bytes for name, run in runs.items()}
        written = [4 if wanted.quick else 300, _CELLS[0] * _CELLS[1], _DIM]
        writing = _race_writing(folder, written[0], rounds)
    numbers = torch.randn(64, slots, _DIM)
    copied = torch.empty_like(numbers)
    held = {dtype: pack(numbers, dtype) for dtype in ("int8", "float8")}
    decoding = race(
        {"copy in float32": lambda: copied.copy_(numbers)}
        | {dtype: lambda dtype=dtype: unpack(held[dtype]) for dtype in held},
        rounds=rounds,
        least_s=0.2,
    )
    report(
        "slots",
        settings={"rows": rows, "rounds": rounds, "decoded": [64, slots, _DIM], "written": written},
        results={
            "extraction": raced.results({"rows": rows}),
            "row_bytes": row_bytes,
            "writing": writing,
            "decoding": decoding.results({"GB_of_float32": numbers.nbytes / 1e9}),
        },
        ratios={"extraction": ratios, "decoding": decoding.ratios("copy in float32")},
        targets=[
            at_least(f"extraction of {name} against the mean alone", ratios[name], 0.9)
            for name in ("mean, grid", "tokens", "tokens, int8")
            if name in ratios
        ],
        quick=wanted.quick,
    )


def _stage_one(folder: Path, name: str, rows: int, stack: ExitStack) -> StageOne:
    """Stage one with a contender's slots and dtype, in a folder of its own."""
    vlm, dtype = CONTENDERS[name]
    params = params_of(folder, "cpu", vlm | {"dtype": "float32"})
    store = folder / f"{name.replace(' ', '-').replace(',', '')}.zarr"
    extract = params.extract.model_copy(update={"store": store, "dtype": dtype})
    params = params.model_copy(update={"extract": extract})
    digests = stack.enter_context(closing(ContentDigests(folder / "digests.sqlite")))
    work = Workload.of(params, rows, digests)
    return StageOne(work, FrozenVLM.load(params.vlm, work.survey.spec, "cpu"), 8)


def _race_writing(folder: Path, rows: int, rounds: int) -> dict[str, dict[str, float]]:
    """A whole store of tokens of random content, from its folder to its seal."""
    place = folder / "written.zarr"
    few = {"episodes": 1, "reuse": 1, "readings": 9, "states": 9, "channels": 9, "dim": _DIM}

    def write() -> None:
        write_store(place, **few, ticks=rows, tokens=_CELLS, dtype="float16")

    def remove() -> None:
        shutil.rmtree(place, ignore_errors=True)

    found = race({"tokens, float16": write}, rounds, 0, before={"tokens, float16": remove})
    row_bytes = _CELLS[0] * _CELLS[1] * _DIM * 2
    return found.results({"rows": rows, "GB": rows * row_bytes / 1e9})


if __name__ == "__main__":
    main()
