"""What each lossless codec makes of A-scans and features: ratio, and MB/s each way.

    python -m benchmarks.compression [--quick] [--rounds N] [--level N] [--store PATH]
                                     [--recordings PATH ...]

Data are inner chunks of an archive, of about 4 MB, spread evenly over an array: the simulated
A-scans, the clock and the features (as float32, float16 and bfloat16) of a store, by default the
demo's, which is made in a temporary folder where there is none; and with `--recordings` the
A-scans of real recordings.

Contenders are the candidates of `stages.archive`, with two that it leaves out: Blosc's shuffles in
blocks of its own size, and numcodecs' Shuffle before Zstd. Every one writes and reads a zarr array
in memory by one thread, in interleaved rounds; one that does not give back every bit ends the run.
"""

import sys
import tempfile
from argparse import Namespace
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm
from zarr.codecs import BloscCodec, BloscShuffle, ZstdCodec
from zarr.codecs.numcodecs import Shuffle

from benchmarks.timing import arguments, at_least, report
from benchmarks.workload import ROWS_AN_EPISODE, write_recordings
from pipeline.base.config import Source, load_params
from pipeline.data import open_recordings
from pipeline.extract import extract
from pipeline.store.archive.codecs import (
    Choice,
    Codec,
    Measured,
    blosc_level,
    choose,
    codecs_for,
    measure,
    outside_the_specification,
)
from pipeline.store.archive.layout import inner_rows
from pipeline.store.archive.source import samples
from pipeline.store.schema import ArraySpec, read_specs
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

Blocks = Sequence[NDArray[Any]]
Rounds = Mapping[str, list[list[Measured]]]
"""By codec, round and block."""


def main() -> None:
    """Measure and print."""
    options = _options()
    rounds = options.rounds or (1 if options.quick else 5)
    results: dict[str, Any] = {}
    ratios: dict[str, float] = {}
    targets: list[dict[str, Any]] = []
    sizes: dict[str, float] = {}
    with _store(options) as store, zarr.config.set({"async.concurrency": 1}):
        for name, blocks in _data(store, options).items():
            codecs = _contenders(blocks[0], options.level)
            measured = _measured(name, codecs, blocks, rounds)
            choice = choose(blocks, _candidates(blocks[0], options.level), worth=1.0)
            results[name] = {
                codec.name: _said(measured[codec.name], codec, choice) for codec in codecs
            }
            chosen = results[name][choice.codec.name]["ratio"]
            ratios[name] = chosen
            sizes[name] = sum(block.nbytes for block in blocks) / 1e6
            best = max(one["ratio"] for one in results[name].values() if one["standard"])
            targets.append(at_least(f"{name}: chosen ratio / best ratio", chosen / best, 0.99))
    report(
        "compression",
        settings={"level": options.level, "rounds": rounds, "threads": 1, "data_MB": sizes},
        results=results,
        ratios=ratios,
        targets=targets,
        quick=options.quick,
    )


def _options() -> Namespace:
    parser = arguments(__doc__ or "")
    parser.add_argument("--level", type=int, default=5, help="of zstd, 1 to 22")
    parser.add_argument("--store", type=Path, help="another store than the one of params.yaml")
    parser.add_argument(
        "--recordings", nargs="*", default=[], metavar="PATH", help="recordings with A-scans"
    )
    return parser.parse_args()


@contextmanager
def _store(options: Namespace) -> Generator[Path]:
    """The store to take data from."""
    there = options.store or load_params(Path("params.yaml")).extract.store
    if there.exists():
        yield there
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        overrides = [
            f"data.root={place / 'recordings'}",
            "data.sources=[{name: raw, path: raw}]",
            f"vlm.checkpoint={place / 'vlm'}",
            f"extract.store={place / 'demo.zarr'}",
        ]
        write_recordings(place, ROWS_AN_EPISODE * (1 if options.quick else 16))
        write_demo_checkpoint(place / "vlm")
        params = load_params(Path("params.yaml"), overrides)
        extract(params, say=lambda line: print(line, file=sys.stderr))
        yield params.extract.store


def _data(store: Path, options: Namespace) -> dict[str, Blocks]:
    """What is compressed, by name."""
    specs, wanted = read_specs(store), 1 if options.quick else 4

    def of(name: str) -> Blocks:
        return samples(store, specs[name], inner_rows(specs[name]), wanted)

    features = of("vl/features")
    found = {"simulated A-scans": of("sensor/values"), "clock": of("sensor/time")}
    found |= {f"features {dtype}": values for dtype, values in _in_each_dtype(features).items()}
    if options.recordings:
        found["recorded A-scans"] = _recorded(options.recordings, wanted)
    return found


def _in_each_dtype(blocks: Blocks) -> dict[str, Blocks]:
    """Features as each dtype would have stored them; those of another dtype stay what they are."""
    if blocks[0].dtype != np.float32:
        return {str(blocks[0].dtype): blocks}
    return {
        "float32": blocks,
        "float16": [block.astype(np.float16) for block in blocks],
        "bfloat16": [(block.view(np.uint32) >> 16).astype(np.uint16) for block in blocks],
    }


def _recorded(paths: Sequence[str], wanted: int) -> Blocks:
    """Chunks of the sensor streams of recordings, episode after episode."""
    sources = [Source(name=path, path=str(Path(path).resolve())) for path in paths]
    opened = open_recordings(sources)
    streams = [stream.values for one in opened.recordings if (stream := one.sensor()) is not None]
    width = max(values.shape[1] for values in streams)
    rows = np.concatenate([values for values in streams if values.shape[1] == width])
    step = inner_rows(ArraySpec("recorded", rows.shape, rows.dtype, ("reading", "channel")))
    starts = np.linspace(0, max(0, len(rows) - step), wanted).astype(int)
    return [rows[start : start + step] for start in np.unique(starts)]


def _candidates(block: NDArray[Any], level: int) -> list[Codec]:
    """The candidates of the archive."""
    return codecs_for(block.dtype, block.ndim, block.nbytes, level)


def _contenders(block: NDArray[Any], level: int) -> list[Codec]:
    """The candidates of the archive, and what it leaves out."""
    found = _candidates(block, level)
    for shuffle in (BloscShuffle.shuffle, BloscShuffle.bitshuffle):
        own_blocks = BloscCodec(cname="zstd", clevel=blosc_level(level), shuffle=shuffle)
        found.append(Codec(f"{shuffle.value}, Blosc's blocks", (), (own_blocks,)))
    with outside_the_specification():
        shuffled = Shuffle(elementsize=block.dtype.itemsize)
    pair = (shuffled, ZstdCodec(level=level))
    return [*found, Codec("numcodecs.shuffle+zstd", (), pair, standard=False)]


def _measured(name: str, codecs: Sequence[Codec], blocks: Blocks, rounds: int) -> Rounds:
    """Every contender once a round; the first round does not count."""
    found: dict[str, list[list[Measured]]] = {codec.name: [] for codec in codecs}
    steps = len(codecs) * (rounds + 1)
    with tqdm(total=steps, unit="run", desc=name, disable=None) as progress:
        for number in range(rounds + 1):
            for codec in codecs:
                of_blocks = [measure(codec, block) for block in blocks]
                if not all(one.exact for one in of_blocks):
                    raise AssertionError(f"{codec.name} loses bits of {name}")
                if number:
                    found[codec.name].append(of_blocks)
                progress.update()
    return found


def _said(of_rounds: Sequence[Sequence[Measured]], codec: Codec, choice: Choice) -> dict[str, Any]:
    """Ratio and the median round's speeds."""
    raw = sum(one.raw_bytes for one in of_rounds[0])
    compress = median(sum(one.compress_s for one in blocks) for blocks in of_rounds)
    decompress = median(sum(one.decompress_s for one in blocks) for blocks in of_rounds)
    return {
        "ratio": round(raw / sum(one.stored_bytes for one in of_rounds[0]), 4),
        "compress_MB_per_s": round(raw / 1e6 / compress, 1),
        "decompress_MB_per_s": round(raw / 1e6 / decompress, 1),
        "standard": codec.standard,
        "chosen": codec.name == choice.codec.name,
    }


if __name__ == "__main__":
    main()
