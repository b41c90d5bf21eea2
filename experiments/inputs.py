"""What each rule of how a policy takes its inputs is worth: errors and closed-loop success without.

    python -m experiments.inputs --out FOLDER [--seeds N] [--only NAME ...] [--latency-ms MS]

Run where params.yaml and the demo's store are, after `dvc repro`. Each variant takes one rule away,
trains the head of params.yaml with each of `seeds` seeds, judges it on the test episodes and rolls
it out; what is done already in FOLDER is not done again. Errors are averaged over the seeds and
compared with the policy as it is by the paired bootstrap over groups of recordings; successes of
all seeds are counted together (Wilson's interval), their episodes are the same ones. Where lateness
is the question, the model also takes `latency-ms`.

The last line is JSON: for each variant both errors in training std, their differences from the
policy as it is, and the success rates.
"""

import csv
import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import run
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import binomtest
from tqdm import tqdm

from pipeline.base.config import load_params
from pipeline.evaluate.intervals import bootstrap_means, interval

FIGURES = ("executed", "overall")


@dataclass(frozen=True)
class Variant:
    """Params that are set, and names of the code with what stands there instead."""

    params: tuple[str, ...] = ()
    patches: Mapping[str, Any] = field(default_factory=dict)
    late: bool = False
    """Whether to roll it out with a slow model too."""

    @property
    def rollouts(self) -> tuple[str, ...]:
        """The folders of its rollouts."""
        return ("rollout", "late") if self.late else ("rollout",)


def _plain(names: Any, units: Any) -> tuple[str, ...]:
    return ("plain",) * len(names)


def _no_age(encoder: Any, age_s: torch.Tensor) -> torch.Tensor:
    return age_s.new_zeros(len(age_s), encoder.network[-1].out_features)


VARIANTS = {
    "as it is": Variant(late=True),
    "readings by their order": Variant(
        ("train_head.sensor_window_s=null", "train_head.state_window_s=null")
    ),
    "angles as numbers": Variant(
        patches={
            "pipeline.policy.state_channels.channel_kinds": _plain,
            "pipeline.train.statistics.channel_kinds": _plain,
        }
    ),
    "no ages": Variant(patches={"pipeline.policy.ages.AgeEncoder.forward": _no_age}),
    "no bounds, no floor": Variant(
        patches={
            "pipeline.policy.policy._LARGEST": 1e9,
            "pipeline.policy.normalization._LEAST_SPREAD": 0.0,
        }
    ),
    "late in training": Variant(
        ("train_head.feature_lag=1", "train_head.sensor_lag_s=0.05"), late=True
    ),
}


def main() -> None:
    """Run what is not done, and print the line."""
    parser = ArgumentParser("experiments.inputs", description="What each rule of inputs is worth.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", nargs="*", choices=[*VARIANTS], default=[*VARIANTS])
    parser.add_argument("--latency-ms", type=float, default=300.0)
    parser.add_argument("--one", nargs=2, metavar=("VARIANT", "SEED"))
    wanted = parser.parse_args()
    if wanted.one:
        name, seed = wanted.one
        _work(VARIANTS[name], int(seed), _folder(wanted.out, name, int(seed)), wanted.latency_ms)
        return
    jobs = [(name, seed) for seed in range(wanted.seeds) for name in wanted.only]
    for name, seed in tqdm(jobs, "inputs", unit="policy", disable=None):
        last = _folder(wanted.out, name, seed) / VARIANTS[name].rollouts[-1]
        if not (last / "metrics.json").exists():
            # A process each: what is patched for one is never seen by another.
            own = ["--out", str(wanted.out), "--latency-ms", str(wanted.latency_ms)]
            command = [sys.executable, "-m", "experiments.inputs", *own, "--one", name, str(seed)]
            run(command, check=True, stdout=sys.stderr)
    rows = {name: _row(wanted.out, name, wanted.seeds) for name in wanted.only}
    print(json.dumps({"seeds": wanted.seeds, "latency_ms": wanted.latency_ms, "variants": rows}))


def _folder(out: Path, name: str, seed: int) -> Path:
    return out / f"{name.replace(' ', '-').replace(',', '')}-{seed}"


def _work(variant: Variant, seed: int, folder: Path, latency_ms: float) -> None:
    """Train, evaluate and roll out, on time and late."""
    from stages import evaluate, rollout, train_head

    late = [f"rollout.latency_ms={latency_ms}"]
    steps: list[tuple[Callable[..., None], list[str]]] = [
        (train_head.main, []),
        (evaluate.main, []),
    ]
    steps += [
        (rollout.main, [f"rollout.output={folder / kind}", *(late if kind == "late" else [])])
        for kind in variant.rollouts
    ]
    common = [
        *variant.params,
        f"train_head.seed={seed}",
        f"train_head.output={folder / 'model'}",
        f"train_head.logs={folder / 'logs'}",
        f"evaluate.output={folder / 'report'}",
        "evaluate.modalities=false",
        "rollout.ablations=false",
    ]
    with ExitStack() as patched:
        for name, value in variant.patches.items():
            patched.enter_context(patch(name, value))
        for work, settings in steps:
            work(load_params(Path("params.yaml"), [*common, *settings]))


def _row(out: Path, name: str, seeds: int) -> dict[str, Any]:
    """The figures of a variant, `[value, low, high]` each."""
    own, counts = _errors(out, name, seeds)
    base, _ = _errors(out, "as it is", seeds)
    row: dict[str, Any] = {}
    for place, figure in enumerate(FIGURES):
        row[figure] = _figure(own[:, place], counts[:, place])
        row[f"{figure}_difference"] = _figure((own - base)[:, place], counts[:, place])
    for kind in VARIANTS[name].rollouts:
        row[f"success_{kind}"] = _success(out, name, seeds, kind)
    return row


def _errors(out: Path, name: str, seeds: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Errors (group, figure) averaged over the seeds, and how many entries stand behind each."""
    errors: list[NDArray[Any]] = []
    counts = np.zeros(0)
    for seed in range(seeds):
        text = (_folder(out, name, seed) / "report" / "groups.csv").read_text(encoding="utf-8")
        rows = sorted(csv.DictReader(text.splitlines()), key=lambda row: row["group"])
        errors.append(np.array([[float(row[f"policy_{f}"]) for f in FIGURES] for row in rows]))
        counts = np.array([[float(row[f"{f}_entries"]) for f in FIGURES] for row in rows])
    return np.mean(errors, axis=0), counts


def _figure(errors: NDArray[Any], counts: NDArray[Any]) -> list[float]:
    sums, entries = (errors * counts)[:, None], counts[:, None]
    low, high = interval(bootstrap_means(sums, entries))
    value = float(sums.sum() / entries.sum())
    return [round(float(number), 4) for number in (value, low[0], high[0])]


def _success(out: Path, name: str, seeds: int, kind: str) -> list[float]:
    told = [
        json.loads((_folder(out, name, seed) / kind / "metrics.json").read_text(encoding="utf-8"))
        for seed in range(seeds)
    ]
    policies = [document["success"]["policy"] for document in told]
    episodes = sum(policy["episodes"] for policy in policies)
    inserted = sum(round(policy["rate"] * policy["episodes"]) for policy in policies)
    edges = binomtest(inserted, episodes).proportion_ci(method="wilson")
    return [round(number, 3) for number in (inserted / episodes, edges.low, edges.high)]


if __name__ == "__main__":
    main()
