"""What makes a policy insert the needle: tables of closed-loop success, each from one command.

    python -m experiments.closed_loop TABLE --out FOLDER [--seeds N] [--episodes N] [--jobs N]

Run where params.yaml and the demo's store are, after `dvc repro`. A table is of recipes (what is
set in training, or replaced in the code) and of the ways in which their policies are rolled out.
Each recipe is trained with each of `seeds` seeds, judged on the test episodes, and rolled out in
`episodes` episodes a seed, others for each seed and the same ones for all recipes. What is done
already in FOLDER is not done again, so a command that was stopped goes on, and tables share
policies; rollouts of another number of episodes are done again.

`worth`, `staleness` and `size` run nothing. They draw what is in FOLDER: success against errors on
recordings, a point a policy; success against what a pass of the model takes (tables `latency`,
`before` and `many`); and success against the bytes of a VL row (tables `slots`, `bytes` and `tuned
tokens`). `pace` trains a few steps of each recipe of `size` in turn, and says how fast.

The last line is JSON: of each row success with Wilson's interval over the rollouts of all seeds,
and the errors in training std over all seeds and their differences from the table's first row
(intervals: paired bootstrap over groups of recordings).
"""

import csv
import json
import os
import sys
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from itertools import product
from pathlib import Path
from subprocess import run
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from tqdm import tqdm

from experiments.recipes import (
    AS_IT_IS,
    EIGHT_BITS,
    LATE,
    NEWEST,
    NOT_ANCHORED,
    ON_TIME,
    PATCHES,
    RECIPES,
    ROLLOUTS,
    STORES,
    TABLES,
    Table,
    store_settings,
)
from pipeline.base.config import load_params
from pipeline.evaluate.figures import bootstrap_means
from pipeline.evaluate.rollouts import EXPERT, POLICY, SuccessRate
from pipeline.store import FeatureStore

FIGURES = ("executed", "overall")
_STEPS, _ROUNDS = 5, 7
"""Of a turn of `pace`, and turns that count."""
_AS_IT_IS = (
    *(f"{key}=null" for key in ("train_head.store", "evaluate.store", "evaluate.checkpoint")),
    *("rollout.checkpoint=null", "rollout.environment=phantom", "rollout.level=full"),
    *("rollout.execute=1", "rollout.chunking=temporal", "rollout.latency_ms=0"),
    "train_head.anchor=auto",
)
"""What a recipe or a rollout takes for granted, whatever params.yaml says."""
_WRITE_PAGE = "pipeline.look.page.writing.write_report"
_SIZED = ("slots", "bytes", "tuned tokens")
_KEPT = tuple(dict.fromkeys(name for table in _SIZED for name in TABLES[table].recipes))
FIRST_SEED = 3_000_000
"""Of the rollouts; each seed of training has a thousand of its own."""


def main() -> None:
    """Run what is not done, and print the table."""
    parser = ArgumentParser("experiments.closed_loop", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("table", choices=[*TABLES, "worth", "staleness", "size", "pace"])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--one", nargs=2, metavar=("RECIPE", "SEED"))
    wanted = parser.parse_args()
    if wanted.one:
        name, seed = wanted.one
        _work(wanted, name, int(seed), TABLES[wanted.table].rollouts)
    elif wanted.table == "worth":
        _draw_worth(wanted.out)
    elif wanted.table == "staleness":
        _draw_staleness(wanted)
    elif wanted.table == "size":
        _draw_size(wanted)
    elif wanted.table == "pace":
        _race_training(wanted.out)
    else:
        _refuse_other_params(wanted.out)
        _make_table(wanted, TABLES[wanted.table])


def _make_table(wanted: Namespace, table: Table) -> None:
    jobs = [(name, seed) for seed in range(wanted.seeds) for name in table.recipes]
    jobs = [job for job in jobs if not _all_done(wanted, *job)]
    _prepare_stores(wanted.out, dict.fromkeys(RECIPES[name].store for name, _ in jobs))
    pool = ThreadPoolExecutor(wanted.jobs)
    try:
        begun = [pool.submit(_run_apart, wanted, name, seed) for name, seed in jobs]
        waiting = as_completed(begun)
        for job in tqdm(waiting, wanted.table, len(begun), unit="policy", disable=None):
            job.result()
    finally:  # what is under way may end, nothing more begins
        pool.shutdown(cancel_futures=True)
    rows = {
        label: row
        for name in table.recipes
        for rollout in table.rollouts
        for label, row in _rows(wanted, name, rollout)
    }
    for label, row in rows.items():
        print(f"{label:<44}", *(f"{key} {value}" for key, value in row.items()))
    settings = {"seeds": wanted.seeds, "episodes_a_seed": wanted.episodes, "from": FIRST_SEED}
    print(json.dumps({"table": wanted.table, **settings, "rows": rows}))


def _refuse_other_params(out: Path) -> None:
    """What is in the folder is of the params that were there when it was begun."""
    params, kept = Path("params.yaml").read_text(encoding="utf-8"), out / "params.yaml"
    out.mkdir(parents=True, exist_ok=True)
    if not kept.exists():
        kept.write_text(params, encoding="utf-8")
    if kept.read_text(encoding="utf-8") != params:
        raise SystemExit(f"{kept}: other params than those here. Name another folder with --out.")


def _prepare_stores(out: Path, names: Iterable[str]) -> None:
    """Make the recordings, models and stores that recipes need beside the demo's."""
    for name in names:
        for stage, settings in STORES[name].steps:
            command = [sys.executable, "-m", f"stages.{stage}"]
            told = [part for text in settings for part in ("--set", text.format(out=out))]
            run([*command, *told], check=True, stdout=sys.stderr)


def _run_apart(wanted: Namespace, name: str, seed: int) -> None:
    """A process a policy: what is replaced for one is never seen by another."""
    threads = {"OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // wanted.jobs))}
    own = ["--out", str(wanted.out), "--episodes", str(wanted.episodes)]
    command = [sys.executable, "-m", "experiments.closed_loop", wanted.table, *own]
    run(
        [*command, "--one", name, str(seed)],
        check=True,
        stdout=sys.stderr,
        env=os.environ | threads,
    )


def _all_done(wanted: Namespace, name: str, seed: int) -> bool:
    folder = _folder(wanted.out, name, seed)
    return all(_is_done(wanted, folder / way) for way in TABLES[wanted.table].rollouts)


def _is_done(wanted: Namespace, rollout: Path) -> bool:
    """Whether a rollout of as many episodes of each controller is there, whole."""
    episodes = _episodes([rollout])
    complete = all(len(rows) == wanted.episodes for rows in episodes.values())
    return complete and {POLICY, EXPERT} <= episodes.keys()


def _folder(out: Path, name: str, seed: int) -> Path:
    return out / f"{name.replace(' ', '-').replace(',', '')}-{seed}"


def _work(wanted: Namespace, name: str, seed: int, rollouts: tuple[str, ...]) -> None:
    """Train and evaluate a recipe, and roll it out in each way that has not been done."""
    from stages import evaluate, rollout, train_head

    recipe, folder = RECIPES[name], _folder(wanted.out, name, seed)
    common = [
        *_AS_IT_IS,
        *store_settings(recipe, wanted.out),
        *recipe.params,
        f"train_head.seed={seed}",
        f"train_head.output={folder / 'model'}",
        f"train_head.logs={folder / 'logs'}",
        f"evaluate.output={folder / 'report'}",
        "evaluate.modalities=false",
        "evaluate.samples=4",
        "rollout.ablations=[]",
        f"rollout.seed={FIRST_SEED + 1000 * seed}",
        f"rollout.episodes={wanted.episodes}",
    ]
    with ExitStack() as patched:
        for place, value in recipe.patches.items():
            patched.enter_context(patch(place, value))
        run_file = folder / "model" / "run.json"
        before = run_file.read_bytes() if run_file.exists() else b""
        train_head.main(load_params(Path("params.yaml"), common))
        if before and run_file.read_bytes() != before:
            raise SystemExit(f"{folder}: was of another store or code. Remove it, and run again.")
        if not (folder / "report" / "judged.json").exists():  # written last
            evaluate.main(load_params(Path("params.yaml"), common))
        for way in rollouts:
            if not _is_done(wanted, folder / way):
                said = [text.format(folder=folder, out=wanted.out) for text in ROLLOUTS[way]]
                told = [*common, *said, f"rollout.output={folder / way}"]
                # Their pages take a tenth of the time; a row that surprises can be run again.
                replaced = {_WRITE_PAGE: lambda *_: [], **PATCHES.get(way, {})}
                with ExitStack() as patched:
                    for place, value in replaced.items():
                        patched.enter_context(patch(place, value))
                    rollout.main(load_params(Path("params.yaml"), told))


def _rows(
    wanted: Namespace, name: str, rollout: str
) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """A row for each controller of a rollout: success, median miss and, in the first, errors."""
    folders = [_folder(wanted.out, name, seed) for seed in range(wanted.seeds)]
    episodes = _episodes([folder / rollout for folder in folders])
    if wanted.table != "levels":
        del episodes[EXPERT]
    for controller, ended in episodes.items():
        miss = float(np.median([float(row["lateral_mm"]) for row in ended]))
        figures = {"success": _success(ended), "lateral_mm": [round(miss, 3)]}
        if controller == POLICY:
            figures["by_training"] = _by_training(folders, rollout)
        if controller == POLICY and rollout == TABLES[wanted.table].rollouts[0]:
            figures |= _errors_beside(wanted, folders)
        others = [] if controller == POLICY else [controller]
        yield " | ".join([name, rollout, *others]), figures


def _episodes(rollouts: list[Path]) -> dict[str, list[dict[str, str]]]:
    """Rows of all episodes of several rollouts, by controller."""
    episodes: dict[str, list[dict[str, str]]] = {}
    for rollout, file in product(rollouts, ("episodes.csv", "beside.csv")):
        for row in _table(rollout / file) if (rollout / file).exists() else ():
            episodes.setdefault(row.get("controller", POLICY), []).append(row)
    return episodes


def _errors_beside(wanted: Namespace, folders: list[Path]) -> dict[str, list[float]]:
    """Both errors, and where the test ticks are the same, less those of the table's first row."""
    own, counts = _errors(folders)
    first = TABLES[wanted.table].recipes[0]
    base = [_folder(wanted.out, first, seed) for seed in range(wanted.seeds)]
    known = all((folder / "report" / "groups.csv").exists() for folder in base)
    before, same = _errors(base) if known else (own, np.zeros(0))
    figures: dict[str, list[float]] = {}
    for place, figure in enumerate(FIGURES):
        figures[figure] = _figure(own[:, place], counts[:, place])
        if np.array_equal(same, counts):
            figures[f"{figure}_difference"] = _figure((own - before)[:, place], counts[:, place])
    return figures


def _errors(folders: list[Path]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Errors (group, figure) averaged over the seeds, and how many entries stand behind each."""
    errors: list[NDArray[Any]] = []
    counts = np.zeros(0)
    for folder in folders:
        rows = sorted(_table(folder / "report" / "groups.csv"), key=lambda row: row["group"])
        errors.append(np.array([[float(row[f"policy_{f}"]) for f in FIGURES] for row in rows]))
        counts = np.array([[float(row[f"{f}_entries"]) for f in FIGURES] for row in rows])
    return np.mean(errors, axis=0), counts


def _table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def _figure(errors: NDArray[Any], counts: NDArray[Any]) -> list[float]:
    sums, entries = (errors * counts)[:, None], counts[:, None]
    low, high = np.nanpercentile(bootstrap_means(sums, entries), [2.5, 97.5], axis=0)
    value = float(sums.sum() / entries.sum())
    return [round(float(number), 4) for number in (value, low[0], high[0])]


def _success(episodes: list[dict[str, str]]) -> list[float]:
    rate = SuccessRate.of([row["success"] == "True" for row in episodes])
    return [round(number, 3) for number in (rate.rate, rate.low, rate.high)]


def _by_training(folders: list[Path], rollout: str) -> list[float]:
    """The success of each training that was rolled out."""
    ended = (_episodes([folder / rollout]).get(POLICY) for folder in folders)
    return [_success(episodes)[0] for episodes in ended if episodes]


def _policies(out: Path) -> Iterator[dict[str, Any]]:
    """Of each policy in a folder that was rolled out on time: recipe, store, success and errors."""
    for name, recipe in RECIPES.items():
        for folder in sorted(out.glob(f"{_folder(Path(), name, 0).name[:-1]}[0-9]")):
            if not (folder / ON_TIME / "beside.csv").exists():
                continue
            errors, counts = _errors([folder])
            values = dict(zip(FIGURES, np.average(errors, axis=0, weights=counts), strict=True))
            success = _success(_episodes([folder / ON_TIME])[POLICY])[0]
            yield {"recipe": name, "store": recipe.store, "success": success, **values}


def _draw_worth(out: Path) -> None:
    """Success against the error of what is executed and of the chunk, with rank correlations.

    These are of the policies that were judged on the demo's test recordings; those of other
    recordings, whose unit is another, stand beside them in grey.
    """
    from pipeline.look.page import style

    policies = list(_policies(out))
    own = [policy for policy in policies if policy["store"] != "many"]
    if len(own) < 3:
        raise SystemExit(f"{out}: expected three policies at least, found {len(own)}: make a table")
    success = [policy["success"] for policy in own]
    ranks: dict[str, Any] = {name: spearmanr([p[name] for p in own], success) for name in FIGURES}
    words = {"executed": "of what is executed", "overall": "of the whole chunk"}

    def draw() -> Any:
        figure, panels = style.panels(9.0, 4.6, 1, 2, sharey=True)
        for axis, name in zip(panels.ravel(), FIGURES, strict=True):
            for policy in policies:
                colour = style.PALETTE[0] if policy in own else "#999999"
                axis.scatter(policy[name], 100 * policy["success"], color=colour)
            axis.set(xlabel=f"error {words[name]} [training std]", ylabel="inserted [%]")
            axis.set_title(f"rank correlation {ranks[name].statistic:+.2f}, {len(own)} policies")
        figure.suptitle("What an error on recordings says of success (grey: on other recordings)")
        return figure

    (picture,) = style.write(out, {"worth.png": draw})
    print(picture)
    told = {name: round(float(rank.statistic), 3) for name, rank in ranks.items()}
    print(json.dumps({"table": "worth", "rank_correlation": told, "policies": policies}))


def _draw_staleness(wanted: Namespace) -> None:
    """Success with its interval against the latency of the model, a curve a recipe."""
    from pipeline.look.page import style

    ways = {ON_TIME: 0, **LATE}
    before = {NEWEST: 0} | {f"{NEWEST}, {late}": ms for late, ms in LATE.items()}
    drawn = [
        ("anchored, 300 demonstrations", "300 demonstrations", ways),
        ("anchored (default)", AS_IT_IS, ways),
        ("anchored, late in training too", "late in training", ways),
        ("as it was: not anchored, newest chunk", NOT_ANCHORED, before),
    ]
    curves: dict[str, dict[int, list[float]]] = {}
    for label, name, played in drawn:
        folders = [_folder(wanted.out, name, seed) for seed in range(wanted.seeds)]
        for way, ms in played.items():
            if episodes := _episodes([folder / way for folder in folders]).get(POLICY):
                curves.setdefault(label, {})[ms] = _success(episodes)
    if not curves:
        raise SystemExit(f"{wanted.out}: nothing to draw. Make the table `latency` there first.")

    def draw() -> Any:
        figure, panels = style.panels(7.5, 4.2, 1, 1)
        for colour, (name, curve) in zip(style.PALETTE, curves.items(), strict=False):
            rate, low, high = 100 * np.array([*curve.values()]).T
            panels.plot([*curve], rate, "o-", color=colour, label=name)
            panels.fill_between([*curve], low, high, color=colour, alpha=0.2, linewidth=0)
        panels.set(xlabel="what a pass of the model takes [ms]", ylabel="inserted [%]")
        panels.legend()
        return figure

    (picture,) = style.write(wanted.out, {"staleness.png": draw})
    print(picture)
    print(json.dumps({"table": "staleness", "by_latency_ms": curves}))


def _draw_size(wanted: Namespace) -> None:
    """Success with its interval against the bytes of a row, a point for what is kept and read."""
    points: dict[str, dict[str, Any]] = {}
    for name in _KEPT:
        folders = [_folder(wanted.out, name, seed) for seed in range(wanted.seeds)]
        if episodes := _episodes([folder / ON_TIME for folder in folders]).get(POLICY):
            told = store_settings(RECIPES[name], wanted.out)
            store = FeatureStore.open(load_params(Path("params.yaml"), told).extract.store)
            row_bytes = store.array("vl/features")[:1].nbytes
            points[name] = {"row_bytes": row_bytes, "success": _success(episodes)}
            points[name] |= {"by_training": _by_training(folders, ON_TIME)}
    if not points:
        raise SystemExit(f"{wanted.out}: nothing to draw. Make the table `slots` there first.")
    print(_draw_points(wanted.out, points))
    print(json.dumps({"table": "size", "points": points}))


def _draw_points(out: Path, points: dict[str, dict[str, Any]]) -> Path:
    """Write the picture of `size`.

    Squares are read by a pooler, triangles have eight bits, hollow points have one training.
    """
    from pipeline.look.page import style

    def draw() -> Any:
        figure, panels = style.panels(9.0, 4.4, 1, 1)
        colours = [*style.PALETTE, "#777777"]
        drawn: Counter[int | str] = Counter()
        for name, point in points.items():
            row_bytes = point["row_bytes"]
            place = row_bytes * 1.05 ** drawn[row_bytes]  # beside those of as many bytes
            rate, low, high = (100 * number for number in point["success"])
            marker = "s" if "pooler" in name else "^" if name in EIGHT_BITS else "o"
            colour = colours[drawn[marker] % len(colours)]
            drawn.update((row_bytes, marker))
            panels.errorbar(
                place,
                rate,
                [[rate - low], [high - rate]],
                fmt=marker,
                fillstyle="full" if len(point["by_training"]) > 1 else "none",
                color=colour,
                label="mean, grid 4x4" if name == AS_IT_IS else name,
            )
        panels.set(xscale="log", xlabel="kB of a VL row's features", ylabel="inserted [%]")
        panels.set_xticks([500, 2000, 5000, 20_000, 100_000], ["0.5", "2", "5", "20", "100"])
        panels.minorticks_off()
        panels.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
        return figure

    (picture,) = style.write(out, {"success_bytes.png": draw})
    return picture


def _race_training(out: Path) -> None:
    """Steps of training a second of a core, of each recipe whose store is there, in turn."""
    from benchmarks.timing import Race
    from benchmarks.train_step import Contender
    from pipeline.train.batches import Prefetch, Windows
    from pipeline.train.loop import Trainer
    from pipeline.train.run import TrainingRun
    from pipeline.train.split import split_by_episode

    torch.set_num_threads(1)
    with TemporaryDirectory() as scratch, ExitStack() as stack:
        contenders: dict[str, Contender] = {}
        for name in _KEPT:
            told = [*_AS_IT_IS, *store_settings(RECIPES[name], out), *RECIPES[name].params]
            params = load_params(Path("params.yaml"), [*told, f"train_head.output={scratch}"])
            if params.extract.store.exists():
                head, store = params.train_head, FeatureStore.open(params.extract.store)
                split = split_by_episode(store, head.split, head.horizon)
                trainer = Trainer(store, head, split, TrainingRun(head.output, "new", (), {}))
                parts, device = trainer.plan.parts_of(range(10**9)), torch.device("cpu")
                feed = stack.enter_context(Prefetch(store, parts, Windows.of(head), device))
                contenders[name] = Contender(trainer, feed, _STEPS)
        seconds: dict[str, list[float]] = {name: [] for name in contenders}
        for _, (name, contender) in product(range(1 + _ROUNDS), contenders.items()):
            begun = time.process_time()
            contender.run()
            seconds[name].append(time.process_time() - begun)
    race = Race({name: taken[1:] for name, taken in seconds.items()})
    results, ratios = race.results({"steps": _STEPS}), race.ratios(AS_IT_IS)
    print(json.dumps({"table": "pace", "core_seconds": results, "ratios": ratios}))


if __name__ == "__main__":
    main()
