"""Meta-World by the protocol of CortexBench, with this project's pipeline.

python -m experiments.metaworld record [--tasks …] [--episodes N] [--seed N] --out FOLDER
python -m experiments.metaworld run [VARIANT …] [--seeds N] [--checkpoint FOLDER] --out FOLDER
python -m experiments.metaworld table --out FOLDER
python -m experiments.metaworld sight VARIANT … [--checkpoint FOLDER] --out FOLDER

`run` records, extracts, trains and rolls out what is missing in the folder; `table` writes tables
and a page of what is finished there; `sight` regresses the places of things from features. With a
checkpoint, give `--set vlm.dtype=bfloat16` and the size of the frames too; `--jobs 1` on a GPU.
"""

import os
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from experiments.metaworld.recording import VERSION, Record, record
from pipeline.base.errors import ConfigError, PipelineError
from pipeline.simulation.meta_world import INSTRUCTIONS, full_name

if TYPE_CHECKING:
    from experiments.metaworld.protocol import Run


_SET: Final = "a param of all policies; what a variant or the run itself sets wins"


def main() -> int:
    """Run what is asked for; a mistake of the user's is one message and exit code 2."""
    parser = ArgumentParser("experiments.metaworld", description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("record", help="record scripted demonstrations, one set a task")
    one.add_argument("--episodes", type=int, default=25, help="of each task, all successful")
    one.add_argument("--seed", type=int, default=0, help="0 to 99; no two share an episode")
    one.add_argument("--image", type=int, default=224, help="height and width of frames")
    one.add_argument("--shadows", action="store_true", help="and reflections; takes longer")
    one.add_argument("--noise", type=float, default=0.0, help="mm, added to each motion")
    one.set_defaults(run=_record)
    whole = commands.add_parser("run", help="policies and rollouts of the protocol")
    whole.add_argument("variants", nargs="*", default=["protocol"], metavar="VARIANT")
    whole.set_defaults(run=_protocol)
    sight = commands.add_parser("sight", help="how well features tell where things are")
    sight.add_argument("variants", nargs="+", metavar="VARIANT")
    sight.set_defaults(run=_sight)
    table = commands.add_parser("table", help="tables of what is finished")
    table.set_defaults(run=_table)
    whole.add_argument("--seeds", type=int, default=3, help="trainings of each variant")
    whole.add_argument("--episodes", type=int, default=25, help="of each rollout")
    for command in (whole, sight):
        command.add_argument(
            "--checkpoint", help="a Qwen2.5-VL; the demo's random weights otherwise"
        )
        command.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=_SET)
    for command in (one, whole, sight):
        command.add_argument("--tasks", nargs="+", default=[*INSTRUCTIONS])
        command.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    for command in (one, whole, table, sight):
        command.add_argument("--out", type=Path, required=True)
    wanted = parser.parse_args()
    try:
        wanted.run(wanted)
    except PipelineError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _record(wanted: Namespace) -> None:
    asked = [
        Record(
            version=VERSION,
            task=full_name(task),
            run=wanted.seed,
            episodes=wanted.episodes,
            image=wanted.image,
            shadows=wanted.shadows,
            noise_mm=wanted.noise,
        )
        for task in dict.fromkeys(wanted.tasks)
    ]
    for kept in record(wanted.out, asked, wanted.jobs):
        failed = f"; the expert failed {len(kept.failed)} more" if kept.failed else ""
        print(f"{wanted.out / kept.task}: {len(kept.seeds)} demonstrations{failed}")


def _protocol(wanted: Namespace) -> None:
    from experiments.metaworld.protocol import run_protocol

    run_protocol(_run(wanted))
    _table(wanted)


def _table(wanted: Namespace) -> None:
    from experiments.metaworld.table import write_tables

    print(write_tables(wanted.out.absolute()))


def _sight(wanted: Namespace) -> None:
    from experiments.metaworld.sight import write_sight

    print(*write_sight(_run(wanted)).text(), sep="\n")


def _run(wanted: Namespace) -> "Run":
    from experiments.metaworld.protocol import VARIANTS, Run

    if unknown := [name for name in wanted.variants if name not in VARIANTS]:
        raise ConfigError(f"expected variants of {', '.join(VARIANTS)}, found {', '.join(unknown)}")
    chosen = {
        name: getattr(wanted, name)
        for name in ("seeds", "episodes", "jobs", "checkpoint")
        if hasattr(wanted, name)
    }
    tasks = tuple(dict.fromkeys(map(full_name, wanted.tasks)))
    out, variants = wanted.out.absolute(), tuple(wanted.variants)
    return Run(out, variants, tasks, settings=tuple(wanted.set), **chosen)


if __name__ == "__main__":
    raise SystemExit(main())
