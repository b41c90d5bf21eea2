"""Stage one against the ways that people extract features without it.

    python -m benchmarks.extract [--quick] [--rounds N] [--rows N] [--batch-size N] [--compile]
                                 [--profile]

Contenders, on the same recordings, frames, prompt, image size, dtype and threads, in one run:

    seeds        (a) batch 1, the whole model with its head, every hidden state kept,
                 transformers' image processor in line, one `torch.save` a feature
    seeds_by_8   (b) the same in batches of 8
    plain        (c) the inner model without head in its best batch of a few, processor in line,
                 masked mean, one array on disk
    ours         stage one's `fill` of a laid-out store, in the batch that `auto` settles on
    ours_every_frame
                 the same without sparing rows and frames that are shown again, which depends on
                 the recordings: what is left is the same model work as the others'

Inside the clock is, for each, decoding, preprocessing, the forward pass and writing; for ours also
row keys, checksums and waiting for the disk. Outside it is, for each, loading the model and looking
for a batch size; for ours the survey and the layout, which the others have no part of.

On the CPU that is the demo's checkpoint at the demo's image size. Where there is CUDA, also
Qwen2.5-VL-3B's real shape with random bfloat16 weights on 3 and on 5 views of 360 x 640, with the
FLOPs of a row as `benchmarks.flops` counts them and the share of the device's peak that is reached.

On a machine with other work, compare `cpu_ms_a_row`: wall time says whose turn it was.
"""

import gc
import tempfile
import time
from argparse import Namespace
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from transformers import Qwen2_5_VLConfig

from benchmarks.cases import Case, demo_case, frozen_model, real_case, whole_model
from benchmarks.flops import RowCost, peak_flops
from benchmarks.plain_ways import PlainWays
from benchmarks.profiling import kernel_table, stopwatch_table
from benchmarks.real_shape import write_shell
from benchmarks.stage_one import StageOne
from benchmarks.timing import Work, arguments, at_least, race, report
from benchmarks.workload import Workload, params_of, write_recordings
from pipeline.base.digests import ContentDigests
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

_NOISE = {"float32": 1e-4, "bfloat16": 0.1}
"""Largest difference between two ways, relative to the features' root mean square."""


@dataclass
class Findings:
    """What a case adds to the report."""

    settings: dict[str, Any]
    results: dict[str, Any]
    ratios: dict[str, float]
    targets: list[dict[str, Any]]


def measure(case: Case, folder: Path, options: Namespace) -> Findings:
    """A case from its recordings to its targets."""
    write_recordings(folder, case.rows, case.views, case.frame_size)
    (write_shell if case.real_shape else write_demo_checkpoint)(folder / "vlm")
    params = params_of(folder, case.device, case.vlm)
    with closing(ContentDigests(folder / "digests.sqlite")) as digests:
        workload = Workload.of(params, case.rows, digests)
        ours = StageOne(workload, frozen_model(case, workload, options.compile), options.batch_size)
        ways = PlainWays(whole_model(case, params), workload, folder / "plain")
        best = _best_batch(ways, case)
        deviation = _deviation(case, ways, ours)
        cost = RowCost.of(
            Qwen2_5_VLConfig.from_pretrained(params.vlm.checkpoint, trust_remote_code=False),
            workload.survey.spec.image_size,
            images=case.views,
            text_tokens=workload.text_tokens(),
        )
        found = _raced(case, ways, best, ours, cost, options.rounds)
        found.settings = {
            "rows": case.rows,
            "rounds": options.rounds,
            "views": case.views,
            "image_size": workload.survey.spec.image_size,
            "dtype": params.vlm.dtype,
            "batch_size": {"plain": best, "ours": ours.batch_size},
            "decode_threads": params.extract.decode_threads,
            "compile": options.compile,
            "distinct_frames_share": workload.distinct_share(),
            "largest_deviation": deviation,
            "tokens_a_row": cost.tokens,
            "flops_a_row": cost.parts,
        }
        if case.device == "cuda":
            _add_utilization(found, case, ours, cost)
        if options.profile:
            ours.prepare()
            table = kernel_table if case.device == "cuda" else stopwatch_table
            found.settings["profile_s"] = table(ours.run)
    return found


def _best_batch(ways: PlainWays, case: Case) -> int:
    """The batch size at which `plain` is fastest, of those that fit."""
    fitting: dict[str, partial[None]] = {}
    for size in case.batch_sizes:
        if size > case.rows:
            break
        try:
            ways.without_head(size)
        except torch.OutOfMemoryError:
            break
        fitting[str(size)] = partial(ways.without_head, size)
    tried = race(fitting, rounds=2, warmup=0)
    return int(min(fitting, key=lambda size: min(tried.seconds[size])))


def _raced(
    case: Case, ways: PlainWays, best: int, ours: StageOne, cost: RowCost, rounds: int
) -> Findings:
    """The race: `_deviation` has let every contender run once before."""
    preparing_s: list[float] = []
    shares: list[tuple[float, float]] = []

    def plain() -> None:
        ways.without_head(best)
        preparing_s.append(ways.preparing_s)

    def stage_one() -> None:
        ours.run()
        shares.append(ours.shares[-1])

    works: dict[str, Work] = {
        "seeds": partial(ways.with_head, 1),
        "seeds_by_8": partial(ways.with_head, 8),
        "plain": plain,
        "ours": stage_one,
        "ours_every_frame": ours.run_every_frame,
    }
    cpu_s: dict[str, list[float]] = {name: [] for name in works}
    contenders = {name: _charged(work, cpu_s[name]) for name, work in works.items()}
    before: dict[str, Work] = {"ours": ours.prepare, "ours_every_frame": ours.prepare}
    done = race(contenders, rounds, warmup=0, before=before)
    results = done.results({"rows": case.rows, "tokens": case.rows * cost.tokens})
    for name, seconds in cpu_s.items():
        results[name]["cpu_ms_a_row"] = 1000 * median(seconds) / case.rows
    parts = zip(preparing_s, done.seconds["plain"], strict=True)
    results["plain"]["preparing_share"] = median(part / whole for part, whole in parts)
    shares_of_ours = (median(each) for each in zip(*shares, strict=True))
    results["ours"]["model_share"], results["ours"]["waiting_share"] = shares_of_ours
    others = ("seeds", "seeds_by_8", "plain")
    speeds = {name: done.speed("ours", name) for name in others}
    speeds |= {f"{name}, every frame": done.speed("ours_every_frame", name) for name in others}
    targets = [
        at_least(f"{case.name}: ours against {name}, times as fast", speeds[name], wanted)
        for name, wanted in case.wanted.items()
    ]
    share = results["ours"]["model_share"]
    targets.append(at_least(f"{case.name}: model time of ours / wall time", share, 0.9))
    return Findings({}, results, speeds, targets)


def _charged(work: Work, cpu_s: list[float]) -> Work:
    """The same work; what all of the process' threads worked meanwhile is noted."""

    def call() -> None:
        begun = time.process_time()
        work()
        cpu_s.append(time.process_time() - begun)

    return call


def _deviation(case: Case, ways: PlainWays, ours: StageOne) -> float:
    """How far features of the other ways are from `plain`'s at most, relative to their size.

    That is their root mean square. Each way runs once; `plain` has. Raises `AssertionError` beyond
    the noise of the dtype: they would not compute the same.
    """
    ours.run()
    ways.with_head(1)
    one_by_one = ways.saved()
    ways.with_head(8)
    wanted = ways.array()
    scale = float(np.sqrt(np.mean(wanted.astype(np.float64) ** 2)))
    others = (ours.features(), one_by_one, ways.saved())
    largest = max(float(np.abs(other - wanted).max()) for other in others) / scale
    noise = _NOISE[case.vlm["dtype"]]
    assert largest <= noise, f"contenders differ by {largest:.2g}, expected at most {noise:g}"
    return largest


def _add_utilization(found: Findings, case: Case, ours: StageOne, cost: RowCost) -> None:
    """Peak memory of ours, FLOP/s, and the share of the GPU's peak that they are."""
    gc.collect()
    torch.cuda.empty_cache()
    held = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    ours.prepare()
    ours.run()
    results = found.results["ours"]
    # The model of the plain ways lies on the same GPU: what was held twice is counted once.
    results["peak_memory_GiB"] = (torch.cuda.max_memory_allocated() - held / 2) / 2**30
    # A frame that stands twice may be encoded twice, in two batches: this says too little then.
    flops_per_s = results["rows_per_s"] * cost.total(found.settings["distinct_frames_share"])
    results["TFLOP_per_s"] = flops_per_s / 1e12
    peak = peak_flops(torch.cuda.get_device_name())
    if peak is not None:
        results["mfu"] = flops_per_s / peak
        found.targets.append(at_least(f"{case.name}: MFU of ours", results["mfu"], 0.55))


def main() -> None:
    """Run the cases that this machine has a device for, and print the report."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--rows", type=int, default=None, help="VL rows that each contender does")
    parser.add_argument("--batch-size", type=int, default=None, help="of ours; else as auto finds")
    parser.add_argument("--compile", action="store_true", help="compile our model first")
    parser.add_argument("--profile", action="store_true", help="also say where our time goes")
    options = parser.parse_args()
    options.rounds = options.rounds or (1 if options.quick else 5)
    if options.quick:
        options.batch_size = options.batch_size or 8
    cuda = torch.cuda.is_available()
    cases = [demo_case(options.rows or (8 if options.quick else 192))]
    if cuda:
        rows = options.rows or (16 if options.quick else 192)
        cases += [real_case(3, rows), real_case(5, rows)]
    found: dict[str, Findings] = {}
    for case in cases:
        with tempfile.TemporaryDirectory() as folder:
            found[case.name] = measure(case, Path(folder), options)
        gc.collect()
    report(
        "extract",
        settings={name: one.settings for name, one in found.items()},
        results={name: one.results for name, one in found.items()},
        ratios={name: one.ratios for name, one in found.items()},
        targets=[target for one in found.values() for target in one.targets],
        quick=options.quick,
        device="cuda" if cuda else "cpu",
    )


if __name__ == "__main__":
    main()
