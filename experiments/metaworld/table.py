"""The tables of a run of the protocol, beside the rows that CortexBench published."""

import csv
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from experiments.metaworld.protocol import PARTS, VARIANTS, TrainedPolicy, found_policies
from pipeline.base.errors import ConfigError
from pipeline.base.text import Table
from pipeline.evaluate.rollouts import SuccessRate, error_bars
from pipeline.look.page.blocks import Picture, Report, Section, Text
from pipeline.look.page.style import PALETTE, finish, panels
from pipeline.look.page.writing import write_report
from pipeline.policy.checkpoint import load_policy
from pipeline.simulation.meta_world import HZ, INSTRUCTIONS

PUBLISHED: Final = {"VC-1 base": "85.3 ± 5.2", "VC-1 large": "88.8 ± 2.2", "Ego4D large": "92.9"}
"""Success in percent on the five tasks, by CortexBench (Majumdar et al. 2023, Table 2)."""
REUSE: Final = {"reuse 1": 1, "reuse 3": 3, "protocol": 10, "reuse 30": 30}
"""Variants that differ in `vlm_reuse_count` alone."""
_RULES: Final = (
    "best: of each training the best of its evaluations, as CortexBench counts, which flatters; it "
    "has 20 of them, a training here three or four. Its spread is the standard deviation of the "
    "trainings. last: the checkpoint at the end. validated: the one that the held-out "
    "demonstrations chose. These have Wilson's 95 % interval over all episodes of all trainings. "
    "Not as CortexBench: v3 tasks (v2 there); the camera corner2, for the package lacks theirs; "
    "frames with the marks of the goal that Meta-World draws; the size of frames, the reuse of "
    "features, chunks and steps of training, as params.yaml says."
)


@dataclass(frozen=True)
class Judged:
    """The success of one policy on one task, by step, and two of the steps."""

    policy: TrainedPolicy
    task: str
    successes: dict[int, list[bool]]
    validated: int

    @property
    def best(self) -> float:
        """The highest rate of all evaluations."""
        return max(float(np.mean(ended)) for ended in self.successes.values())

    @property
    def last(self) -> list[bool]:
        """The episodes of the last checkpoint."""
        return self.successes[max(self.successes)]


def judged(out: Path) -> list[Judged]:
    """Every policy in the folder that is finished, once for each of its tasks."""
    return [one for policy in found_policies(out) if policy.done for one in _judged(policy)]


def _judged(policy: TrainedPolicy) -> Iterator[Judged]:
    validated = load_policy(policy.model / "best").step
    rows = {step: _rows(policy.rollout(step) / "episodes.csv") for step in policy.checkpoints}
    for task in policy.tasks:
        ended = {
            step: [row["success"] == "True" for row in episodes if row["level"] == task]
            for step, episodes in rows.items()
        }
        yield Judged(policy, task, ended, validated)


def success_table(name: str, policies: Sequence[Judged]) -> Table:
    """A row for each task, and their mean over the trainings of all of these, of one variant."""
    tasks = _tasks(policies)
    rows = [_row(task, [p for p in policies if p.task == task]) for task in tasks]
    heads = ("task", "best", "last", "validated", "policies", "episodes")
    if whole := _of_all(policies):
        rows.append(_row(f"mean of {len(tasks)}", whole))
    return Table(heads, rows, name)


def _of_all(policies: Sequence[Judged]) -> list[Judged]:
    """Those of the trainings that are finished for every task."""
    tasks = Counter(one.policy.seed for one in policies)
    return [one for one in policies if tasks[one.policy.seed] == len(_tasks(policies))]


def overview(by_variant: Mapping[str, Sequence[Judged]]) -> Table:
    """The success of the last checkpoint: a row for each variant, a column for each task."""
    tasks = _tasks([one for own in by_variant.values() for one in own])
    rows = list[tuple[str, ...]]()
    for name, own in by_variant.items():
        ended = [[s for p in own if p.task == task for s in p.last] for task in tasks]
        shown = [f"{np.mean(one):.0%}" if one else "" for one in ended]
        whole = [s for p in _of_all(own) for s in p.last] if all(ended) else []
        rows.append((name, *shown, str(SuccessRate.of(whole)) if whole else ""))
    return Table(("variant", *tasks, "mean"), rows, "Success of the last checkpoint")


def _row(label: str, policies: Sequence[Judged]) -> tuple[Any, ...]:
    by_seed = [
        100 * float(np.mean([p.best for p in policies if p.policy.seed == seed]))
        for seed in sorted({p.policy.seed for p in policies})
    ]
    best = f"{np.mean(by_seed):.1f}" + (f" ± {np.std(by_seed):.1f}" if len(by_seed) > 1 else "")
    last = [success for p in policies for success in p.last]
    chosen = [success for p in policies for success in p.successes[p.validated]]
    rates = (str(SuccessRate.of(last)), str(SuccessRate.of(chosen)))
    return (label, best, *rates, len(policies), len(last))


def parts_table(out: Path) -> Table:
    """What the parts of all runs in the folder made, and the wall clock that they took."""
    parts, file = dict[str, list[float]](), out / PARTS
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    for part, *told in csv.reader(lines):
        whole = parts.setdefault(part, [0.0, 0.0])
        parts[part] = [have + float(more) for have, more in zip(whole, told, strict=True)]
    rows = [
        (part, int(made), f"{seconds / 3600:.2f}", f"{seconds / made:.3g}" if made else "-")
        for part, (seconds, made) in parts.items()
    ]
    return Table(("part", "made", "hours", "seconds each"), rows, "Wall clock of the parts")


def write_tables(out: Path) -> Path:
    """Write page and `tables.json` of what is finished; returns the page.

    Raises `ConfigError` where nothing is.
    """
    if not (policies := judged(out)):
        raise ConfigError(f"{out}: no finished policy. Name the folder of a run with --out")
    by_variant = {
        name: own
        for name in VARIANTS
        if (own := [one for one in policies if one.policy.variant == name])
    }
    tables = {name: success_table(name, own) for name, own in by_variant.items()}
    parts = parts_table(out)
    whole = overview(by_variant)
    for table in (*tables.values(), whole, parts):
        print(table.caption, *table.text(), sep="\n")
    content = {
        "published": PUBLISHED,
        "variants": {name: _content(table) for name, table in tables.items()},
        "parts": _content(parts),
    }
    (out / "tables.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    pictures = list[Picture]()
    reuse = {REUSE[name]: own for name, own in by_variant.items() if name in REUSE}
    if len(reuse) > 1 and (shared := _shared_tasks(reuse)):
        told = "Ticks of 12.5 ms that share a pass of the model; last checkpoints, 95 % intervals."
        pictures.append(Picture("reuse", told, partial(_draw_reuse, reuse, shared)))
    beside = Table(("encoder", "best"), list(PUBLISHED.items()), "CortexBench, published")
    report = Report(
        "Meta-World by CortexBench's protocol",
        "Frozen features of a vision-language model on tasks that this project did not make.",
        [],
        (
            Section("Success", [Text(_RULES), whole, *pictures, beside]),
            Section("Each variant", [*tables.values()]),
            Section("What it took", [parts]),
            Section("Films", [*_films(policies)]),
        ),
    )
    write_report(out / "report", report)
    return out / "report" / "report.html"


def _content(table: Table) -> dict[str, Sequence[Any]]:
    return {row[0]: row[1:] for row in table.rows}


def _films(policies: Sequence[Judged]) -> Iterator[Text]:
    for policy in dict.fromkeys(one.policy for one in policies):
        page = policy.rollout(max(policy.checkpoints)) / "report.html"
        told = f"{policy.variant}, {policy.task}, seed {policy.seed}: "
        yield Text(told, str(Path("..") / page.relative_to(policy.run.out)))


def _shared_tasks(reuse: Mapping[int, Sequence[Judged]]) -> list[str]:
    return [task for task in INSTRUCTIONS if all(task in _tasks(own) for own in reuse.values())]


def _draw_reuse(own: Mapping[int, Sequence[Judged]], shared: Sequence[str]) -> Figure:
    counts = sorted(own)
    figure, axis = panels(6.0, 3.8, 1, 1)
    for place, label in enumerate([*shared, f"mean of {len(shared)}"]):
        tasks = [label] if label in shared else shared
        centre, bars = error_bars(
            SuccessRate.of([s for p in own[count] if p.task in tasks for s in p.last])
            for count in counts
        )
        moved = np.array(counts) * 1.03 ** (place - 1)  # so that intervals stay apart
        style = {"color": PALETTE[place], "label": label, "marker": "o", "capsize": 2}
        axis.errorbar(moved, centre, yerr=bars, **style)
    axis.set(xscale="log", ylim=(0, 104), xlabel="control ticks a pass", ylabel="success [%]")
    axis.set_xticks(counts, [f"{n}\n{HZ / n:.3g} a second" for n in counts], minor=False)
    axis.minorticks_off()
    finish(figure, axis, 3, "Success against vlm_reuse_count")
    return figure


def _tasks(policies: Sequence[Judged]) -> list[str]:
    return list(dict.fromkeys(one.task for one in policies))


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
