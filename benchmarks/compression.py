"""What each lossless codec makes of A-scans and features: ratio, and MB/s each way.

    python -m benchmarks.compression [--quick] [--rounds N] [--level N] [--store PATH]
                                     [--recordings PATH ...]

Data are inner chunks of an archive, of about 4 MB, spread evenly over an array: the simulated
A-scans, the clock and the features (as float32, float16 and bfloat16) of a store, by default the
demo's, which is made in a temporary folder where there is none; and with `--recordings` the
A-scans of real recordings.

Contenders are Blosc's zstd on a whole chunk as it is, or with its bytes or bits shuffled; each of
these with every channel of the chunk stored for itself (a transpose, so that neighbours in time are
neighbours in the file), or for integers with numcodecs' Delta before; in blocks of Blosc's own
size; and numcodecs' Shuffle before Zstd. `stages.archive` takes one of them for each dtype
(`pipeline.store.archive.codec_for`), which has to come near the best. Every contender writes and
reads a zarr array in memory by one thread, in interleaved rounds; one that does not give back every
bit ends the run.
"""

import sys
import tempfile
import time
import warnings
from argparse import Namespace
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from tqdm import tqdm
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec, TransposeCodec, ZstdCodec
from zarr.codecs.numcodecs import Delta, Shuffle
from zarr.errors import ZarrUserWarning

from benchmarks.timing import arguments, at_least, report
from benchmarks.workload import ROWS_AN_EPISODE, write_recordings
from pipeline.base.config import Source, load_params
from pipeline.data import open_recordings
from pipeline.extract import extract
from pipeline.store.archive import codec_for, inner_rows
from pipeline.store.chunks import read_rows
from pipeline.store.schema import ArraySpec, read_specs
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

Blocks = Sequence[NDArray[Any]]
NEAR = 0.95
"""Share of the best ratio that the archive's codec has to reach."""


@dataclass(frozen=True)
class Codec:
    """One way to store an inner chunk without loss."""

    filters: tuple[Any, ...] = ()
    compressors: tuple[Any, ...] = ()
    standard: bool = True
    """Whether every implementation of zarr v3 has it, or zarr-python alone."""


@dataclass(frozen=True)
class Measured:
    """What one codec makes of one inner chunk."""

    raw_bytes: int
    stored_bytes: int
    compress_s: float
    decompress_s: float


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
            ours = _archives(blocks[0], options.level)
            results[name] = {
                label: _said(measured[label], codec, label == ours)
                for label, codec in codecs.items()
            }
            ratios[name] = results[name][ours]["ratio"]
            sizes[name] = sum(block.nbytes for block in blocks) / 1e6
            best = max(one["ratio"] for one in results[name].values() if one["standard"])
            what = f"{name}: the archive's ratio / best ratio"
            targets.append(at_least(what, ratios[name] / best, NEAR))
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
        spec = specs[name]
        step = min(inner_rows(spec), spec.shape[0] // 8 * 8)  # bits are shuffled of 8 rows at least
        starts = np.linspace(0, spec.shape[0] - step, wanted).astype(int)
        return [read_rows(store, spec, start, start + step) for start in np.unique(starts)]

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
    step = inner_rows(ArraySpec("recorded", rows.shape, rows.dtype))
    starts = np.linspace(0, max(0, len(rows) - step), wanted).astype(int)
    return [rows[start : start + step] for start in np.unique(starts)]


def _contenders(block: NDArray[Any], level: int) -> dict[str, Codec]:
    """By name, the simplest first."""
    ours = codec_for(block.dtype, block.nbytes, level)

    def blosc(shuffle: BloscShuffle, block_bytes: int = block.nbytes) -> BloscCodec:
        return BloscCodec(cname="zstd", clevel=ours.clevel, shuffle=shuffle, blocksize=block_bytes)

    found = {"none": Codec()}
    for shuffle in BloscShuffle:
        found[shuffle.value] = Codec((), (blosc(shuffle),))
        found[f"{shuffle.value}, Blosc's blocks"] = Codec((), (blosc(shuffle, 0),))
        if block.ndim > 1:
            last_first = TransposeCodec(order=(*range(1, block.ndim), 0))
            found[f"transpose+{shuffle.value}"] = Codec((last_first,), (blosc(shuffle),))
        if block.dtype.kind in "iu":
            with _numcodecs():
                delta = Delta(dtype=block.dtype.str)
            found[f"delta+{shuffle.value}"] = Codec((delta,), (blosc(shuffle),), standard=False)
    with _numcodecs():
        pair = (Shuffle(elementsize=block.dtype.itemsize), ZstdCodec(level=level))
    return found | {"numcodecs.shuffle+zstd": Codec((), pair, standard=False)}


def _archives(block: NDArray[Any], level: int) -> str:
    """The name of the contender that an archive takes."""
    return codec_for(block.dtype, block.nbytes, level).shuffle.value


@contextmanager
def _numcodecs() -> Generator[None]:
    """Silence that zarr v3 does not specify these codecs, and nothing else."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Numcodecs codecs are not in the Zarr", ZarrUserWarning)
        yield


def _measured(name: str, codecs: Mapping[str, Codec], blocks: Blocks, rounds: int) -> Rounds:
    """Every contender once a round; the first round does not count."""
    found: dict[str, list[list[Measured]]] = {label: [] for label in codecs}
    steps = len(codecs) * (rounds + 1)
    with tqdm(total=steps, unit="run", desc=name, disable=None) as progress:
        for number in range(rounds + 1):
            for label, codec in codecs.items():
                of_blocks = [_measure(label, codec, block) for block in blocks]
                if number:
                    found[label].append(of_blocks)
                progress.update()
    return found


def _measure(label: str, codec: Codec, block: NDArray[Any]) -> Measured:
    """Store a block as zarr would store it as an inner chunk, and read it back."""
    stored: dict[str, Any] = {}
    begun = time.perf_counter()
    with _numcodecs():
        array = zarr.create_array(
            stored,
            shape=block.shape,
            chunks=block.shape,
            dtype=block.dtype,
            filters=codec.filters,
            compressors=[*codec.compressors, Crc32cCodec()],
            fill_value=0,
            config={"write_empty_chunks": True},
        )
    array[...] = block
    written = time.perf_counter()
    back = np.ascontiguousarray(array[...])
    read = time.perf_counter()
    if back.tobytes() != block.tobytes():
        raise AssertionError(f"{label} loses bits")
    return Measured(
        raw_bytes=block.nbytes,
        stored_bytes=sum(len(value) for name, value in stored.items() if name != "zarr.json"),
        compress_s=written - begun,
        decompress_s=read - written,
    )


def _said(of_rounds: Sequence[Sequence[Measured]], codec: Codec, chosen: bool) -> dict[str, Any]:
    """Ratio and the median round's speeds."""
    raw = sum(one.raw_bytes for one in of_rounds[0])
    compress = median(sum(one.compress_s for one in blocks) for blocks in of_rounds)
    decompress = median(sum(one.decompress_s for one in blocks) for blocks in of_rounds)
    return {
        "ratio": round(raw / sum(one.stored_bytes for one in of_rounds[0]), 4),
        "compress_MB_per_s": round(raw / 1e6 / compress, 1),
        "decompress_MB_per_s": round(raw / 1e6 / decompress, 1),
        "standard": codec.standard,
        "chosen": chosen,
    }


if __name__ == "__main__":
    main()
