"""Contenders against the clock in interleaved rounds, and the one JSON line that says how it went.

A machine drifts: contenders that run one after the other are compared with its mood. Here each
round runs every contender once, ratios are taken within a round, and their median is reported.
"""

import gc
import json
import os
import platform
import shlex
import statistics
import sys
import time
from argparse import ArgumentParser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from math import ceil
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

Work = Callable[[], object]

_PACKAGES = ("torch", "numpy", "zarr", "transformers", "dask")


@dataclass(frozen=True)
class Race:
    """Seconds of one call of each contender, round by round."""

    seconds: Mapping[str, list[float]]

    def median(self, name: str) -> float:
        """Seconds of a call in the median round."""
        return statistics.median(self.seconds[name])

    def speed(self, name: str, baseline: str) -> float:
        """How many times as fast as `baseline`: the median of the ratios of each round."""
        pairs = zip(self.seconds[baseline], self.seconds[name], strict=True)
        return statistics.median(slow / fast for slow, fast in pairs)

    def results(self, units: Mapping[str, float] | None = None) -> dict[str, dict[str, float]]:
        """Median, fastest and slowest seconds of each contender.

        `units` are amounts of work a call by name of their unit, as `{"rows": 256, "GB": 0.001}`:
        each adds `<unit>_per_s` at the median.
        """
        return {
            name: {
                "median_s": _rounded(self.median(name)),
                "min_s": _rounded(min(seconds)),
                "max_s": _rounded(max(seconds)),
                **{
                    f"{unit}_per_s": _rounded(amount / self.median(name))
                    for unit, amount in (units or {}).items()
                },
            }
            for name, seconds in self.seconds.items()
        }

    def ratios(self, baseline: str) -> dict[str, float]:
        """`speed` of each other contender against `baseline`."""
        others = (name for name in self.seconds if name != baseline)
        return {name: _rounded(self.speed(name, baseline)) for name in others}


def race(
    contenders: Mapping[str, Work],
    rounds: int = 7,
    warmup: int = 1,
    least_s: float = 0.0,
    before: Mapping[str, Work] | None = None,
) -> Race:
    """Run every contender once a round, in turn, after `warmup` rounds that do not count.

    What takes less than `least_s` is called as often in a row as fills it, and its seconds are
    divided by that. `before` is what a contender needs first, every time, off the clock. Work that
    a contender left on a GPU is waited for.
    """
    prepare = before or {}
    calls = dict.fromkeys(contenders, 1)
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    steps = (warmup + rounds) * len(contenders)
    gc.collect()
    gc.freeze()  # what is there already need not be looked through before every call
    try:
        with tqdm(total=steps, unit="run", desc="benchmark", disable=None) as progress:
            for number in range(warmup + rounds):
                for name, work in contenders.items():
                    progress.set_postfix_str(name)
                    prepare.get(name, _nothing)()
                    taken = _clocked(work, calls[name])
                    if number < warmup:
                        calls[name] = max(1, ceil(least_s / max(taken, 1e-9)))
                    else:
                        seconds[name].append(taken)
                    progress.update()
    finally:
        gc.unfreeze()
    return Race(seconds)


def _clocked(work: Work, calls: int) -> float:
    """Seconds a call; no garbage is collected meanwhile."""
    gc.collect()
    gc.disable()
    try:
        _wait_for_gpu()
        begun = time.perf_counter()
        for _ in range(calls):
            work()
        _wait_for_gpu()
        return (time.perf_counter() - begun) / calls
    finally:
        gc.enable()


def _wait_for_gpu() -> None:
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _nothing() -> None:
    """What most contenders need first."""


def _rounded(value: float) -> float:
    """To five significant digits: no clock says more."""
    return float(f"{value:.5g}")


def at_least(what: str, found: float, wanted: float) -> dict[str, Any]:
    """A target of the report that `found` has to reach."""
    return {
        "what": what,
        "found": _rounded(found),
        "wanted": f">= {wanted:g}",
        "reached": found >= wanted,
    }


def at_most(what: str, found: float, wanted: float) -> dict[str, Any]:
    """A target of the report that `found` has to stay within."""
    return {
        "what": what,
        "found": _rounded(found),
        "wanted": f"<= {wanted:g}",
        "reached": found <= wanted,
    }


def arguments(doc: str) -> ArgumentParser:
    """A parser with what every benchmark takes: `--quick` and `--rounds`."""
    parser = ArgumentParser(description=doc.strip().partition("\n")[0])
    parser.add_argument(
        "--quick", action="store_true", help="small and short: proves that it runs, measures little"
    )
    parser.add_argument("--rounds", type=int, default=None, help="rounds that count")
    return parser


def report(
    benchmark: str,
    *,
    settings: Mapping[str, Any],
    results: Mapping[str, Any],
    ratios: Mapping[str, Any],
    targets: list[dict[str, Any]],
    quick: bool = False,
    device: str = "cpu",
) -> None:
    """Print the one JSON line of a benchmark on stdout.

    `targets` are what `at_least` and `at_most` give; a quick run's say nothing, so `quick` stands
    beside them.
    """
    line = {
        "benchmark": benchmark,
        "command": command(),
        "quick": quick,
        "machine": machine(device),
        "settings": dict(settings),
        "results": dict(results),
        "ratios": dict(ratios),
        "targets": targets,
    }
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def command() -> str:
    """What to type to run this again."""
    script = Path(sys.argv[0])
    if script.parent.name == "benchmarks":
        return shlex.join(["python", "-m", f"benchmarks.{script.stem}", *sys.argv[1:]])
    return shlex.join([script.name, *sys.argv[1:]])


def machine(device: str = "cpu") -> dict[str, Any]:
    """What the figures depend on; `device` is torch's name of it."""
    kind = torch.device(device)
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "torch_threads": torch.get_num_threads(),
        "ram_GiB": _rounded(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30),
        "load_1min": _rounded(os.getloadavg()[0]),
        "device": torch.cuda.get_device_name(kind) if kind.type == "cuda" else kind.type,
        "python": platform.python_version(),
        **{name: found for name in _PACKAGES if (found := _version(name)) is not None},
    }


def _cpu_model() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
