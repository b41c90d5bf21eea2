"""Meta-World by the protocol of CortexBench, with this project's pipeline.

python -m experiments.metaworld record [--tasks …] [--episodes N] [--seed N] --out FOLDER
"""

import os
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from experiments.metaworld.recording import Record, record
from pipeline.base.errors import PipelineError
from pipeline.simulation.meta_world import INSTRUCTIONS, full_name


def main() -> int:
    """Run what is asked for; a mistake of the user's is one message and exit code 2."""
    parser = ArgumentParser("experiments.metaworld", description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("record", help="record scripted demonstrations, one set a task")
    one.add_argument("--tasks", nargs="+", default=[*INSTRUCTIONS])
    one.add_argument("--episodes", type=int, default=25, help="of each task, all successful")
    one.add_argument("--seed", type=int, default=0, help="0 to 99; no two share an episode")
    one.add_argument("--image", type=int, default=224, help="height and width of frames")
    one.add_argument("--shadows", action="store_true", help="and reflections; takes longer")
    one.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    one.add_argument("--out", type=Path, required=True)
    one.set_defaults(run=_record)
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
            task=full_name(task),
            run=wanted.seed,
            episodes=wanted.episodes,
            image=wanted.image,
            shadows=wanted.shadows,
        )
        for task in dict.fromkeys(wanted.tasks)
    ]
    for kept in record(wanted.out, asked, wanted.jobs):
        failed = f"; the expert failed {len(kept.failed)} more" if kept.failed else ""
        print(f"{wanted.out / kept.task}: {len(kept.seeds)} demonstrations{failed}")


if __name__ == "__main__":
    raise SystemExit(main())
