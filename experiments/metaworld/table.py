"""The tables of a run of the protocol, beside the rows that CortexBench published."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from experiments.metaworld.protocol import PARTS, VARIANTS, Run, TrainedPolicy
from pipeline.base.text import Table
from pipeline.evaluate.rollouts import SuccessRate, error_bars
from pipeline.look.page.blocks import Picture, Report, Section, Text
from pipeline.look.page.style import PALETTE, finish, panels
from pipeline.look.page.writing import write_report
from pipeline.policy.checkpoint import find_policy, load_policy
from pipeline.simulation.meta_world import HZ, INSTRUCTIONS

PUBLISHED: Final = {"VC-1 base": "85.3 ± 5.2", "VC-1 large": "88.8 ± 2.2", "Ego4D large": "92.9"}
"""Success in percent on the five tasks, by CortexBench (Majumdar et al. 2023, Table 2)."""
REUSE: Final = {"reuse 1": 1, "reuse 3": 3, "protocol": 10, "reuse 30": 30}
"""Variants that differ in `vlm_reuse_count` alone."""
_RULES: Final = (
    "best: of each training the best of its evaluations, as CortexBench counts, which flatters. "
    "last: the checkpoint at the end. validated: the one that the held-out demonstrations chose. "
    "These have Wilson's 95 % interval over all episodes of all seeds. v3 tasks and the camera "
    "corner2, where CortexBench has v2 and a camera that the package lacks; frames have the marks "
    "of the goal that Meta-World draws."
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


def judged(run: Run) -> list[Judged]:
    """Every policy of the run that is finished, once for each of its tasks."""
    return [one for policy in run.policies() if policy.done for one in _judged(policy)]


def _judged(policy: TrainedPolicy) -> Iterator[Judged]:
    validated = load_policy(find_policy(policy.folder / "model")).step
    rows = {step: _rows(folder / "episodes.csv") for step, folder in policy.rollouts().items()}
    for task in policy.tasks:
        ended = {
            step: [row["success"] == "True" for row in episodes if row["level"] == task]
            for step, episodes in rows.items()
        }
        yield Judged(policy, task, ended, validated)


def success_table(name: str, policies: Sequence[Judged]) -> Table:
    """A row for each task, and their mean, of one variant."""
    tasks = _tasks(policies)
    rows = [_row(task, [p for p in policies if p.task == task]) for task in tasks]
    heads = ("task", "best", "last", "validated", "policies", "episodes")
    return Table(heads, [*rows, _row(f"mean of {len(tasks)}", policies)], name)


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


def write_tables(run: Run) -> Path:
    """Write page and `tables.json`; returns the page. Only finished policies count."""
    policies = judged(run)
    by_variant = {
        name: own
        for name in VARIANTS
        if (own := [one for one in policies if one.policy.variant == name])
    }
    tables = [success_table(name, own) for name, own in by_variant.items()]
    beside = Table(("encoder", "best"), list(PUBLISHED.items()), "CortexBench, published")
    parts = parts_table(run.out)
    for table in (*tables, parts):
        print(table.caption, *table.text(), sep="\n")
    figures = {name: {row[0]: row[1:] for row in t.rows} for name, t in zip(by_variant, tables)}  # noqa: B905
    content = {
        "published": PUBLISHED,
        "episodes": run.episodes,
        "variants": figures,
        "parts": {row[0]: row[1:] for row in parts.rows},
    }
    (run.out / "tables.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    picture = Picture(
        "success", "The last checkpoint, with 95 % intervals.", partial(_draw, by_variant)
    )
    pictures = [picture]
    if len([name for name in by_variant if name in REUSE]) > 1:
        drawn = partial(_draw_reuse, by_variant)
        told = "Ticks of 12.5 ms that share a pass of the model; last checkpoints, 95 % intervals."
        pictures.append(Picture("reuse", told, drawn))
    report = Report(
        "Meta-World by CortexBench's protocol",
        "Frozen features of a vision-language model on tasks that this project did not make.",
        [],
        (
            Section("Success", [Text(_RULES), *pictures, *tables, beside]),
            Section("What it took", [parts]),
            Section("Films", [Text(f"Each policy's page is in {run.out / 'policies'}.")]),
        ),
    )
    write_report(run.out / "report", report)
    return run.out / "report" / "report.html"


def _draw(by_variant: dict[str, list[Judged]]) -> Figure:
    tasks = _tasks([one for own in by_variant.values() for one in own])
    figure, axis = panels(9.0, 1.2 + 0.35 * len(by_variant) * (len(tasks) + 1) / 2, 1, 1)
    labels, named = [*tasks, "mean"], set[str]()
    for place, (name, own) in enumerate(by_variant.items()):
        for at, label in enumerate(labels):
            whole = label == "mean" and _tasks(own) == tasks
            ended = [s for p in own if whole or p.task == label for s in p.last]
            if not ended:  # this variant was run on other tasks
                continue
            centre, bars = error_bars([SuccessRate.of(ended)])
            height = at + 0.8 * (place + 0.5) / len(by_variant)
            style = {
                "color": PALETTE[place % len(PALETTE)],
                "label": None if name in named else name,
            }
            named.add(name)
            axis.errorbar(centre, height, xerr=bars, fmt="o", **style)
    axis.set(xlim=(-2, 102), xlabel="success [%]", yticks=np.arange(len(labels)) + 0.4)
    axis.set_yticklabels(labels)
    axis.invert_yaxis()
    finish(figure, axis, 4, "Success of the last checkpoint")
    return figure


def _draw_reuse(by_variant: dict[str, list[Judged]]) -> Figure:
    own = {REUSE[name]: policies for name, policies in by_variant.items() if name in REUSE}
    shared = [task for task in INSTRUCTIONS if all(task in _tasks(p) for p in own.values())]
    counts = sorted(own)
    figure, axis = panels(6.0, 3.4, 1, 1)
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
    finish(figure, axis, 1, "Success against vlm_reuse_count")
    return figure


def _tasks(policies: Sequence[Judged]) -> list[str]:
    return list(dict.fromkeys(one.task for one in policies))


def _rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
