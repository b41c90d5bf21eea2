"""What it takes to open recordings and to read them whole: this code beside another checkout's.

Each code reads in a process of its own, and each round asks both, so that a machine that drifts is
the same for both. Opening finds the episodes and reads their metadata; reading takes every stream
and the first frames of every view; checking asks for the sizes of those frames and whether they can
be decoded.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from benchmarks.timing import Work, arguments, at_most, race, report
from pipeline.simulation.demo_recordings import write_demo_recordings

ROOT = Path(__file__).resolve().parents[1]
WAYS = ("open", "read", "check")
SLOWER = 1.1
"""How many times as long it may take: two runs of one code differ by this much."""
PROGRAM = """
import sys
from pathlib import Path
from pipeline.base.config import Source
from pipeline.data import open_recordings

sources = [Source(name=str(n), path=path) for n, path in enumerate(sys.argv[1:])]
for line in sys.stdin:
    for recording in open_recordings(sources).recordings:
        if line.strip() == "read":
            recording.state(), recording.sensor(), recording.instruction
            recording.poses() if recording.has_poses else recording.action()
            for camera in recording.cameras().values():
                for frame in camera.read(range(min(10, len(camera.time)))):
                    pass
        if line.strip() == "check":
            for camera in recording.cameras().values():
                camera.check(range(min(10, len(camera.time))))
    print(line, end="", flush=True)
"""
"""What either code runs: only names that both have."""


def main() -> None:
    """Start the readers, race them, print."""
    parser = arguments(__doc__ or "")
    parser.add_argument("folders", nargs="*", type=Path, help="recordings; simulated where none")
    parser.add_argument("--against", type=Path, default=ROOT, help="another checkout")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as readers:
        if not options.folders:
            write_demo_recordings(Path(scratch), episodes=1 if options.quick else 4, seed=0)
        folders = [folder.resolve() for folder in options.folders or [Path(scratch)]]
        codes = {"here": ROOT, "against": options.against.resolve()}
        asked = {name: _reader(readers, code, folders) for name, code in codes.items()}
        contenders: dict[str, Work] = {
            f"{way}, {name}": partial(ask, way) for way in WAYS for name, ask in asked.items()
        }
        result = race(contenders, rounds=options.rounds or (2 if options.quick else 30))
    ratios = {way: 1 / result.speed(f"{way}, here", f"{way}, against") for way in WAYS}
    report(
        "reading",
        settings={"folders": list(map(str, options.folders)), "against": str(options.against)},
        results=result.results(),
        ratios=ratios,
        targets=[at_most(f"{way}: times as long as there", ratios[way], SLOWER) for way in WAYS],
        quick=options.quick,
    )


def _reader(readers: ExitStack, code: Path, folders: list[Path]) -> Callable[[str], None]:
    """Ask a process of that code to go over these recordings in a way, and wait for it."""
    process = readers.enter_context(
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *map(str, folders)],
            cwd=code,
            env=os.environ | {"PYTHONPATH": str(code)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
    )
    asks, answers = process.stdin, process.stdout
    assert asks is not None
    assert answers is not None

    def ask(way: str) -> None:
        print(way, file=asks, flush=True)
        if answers.readline().strip() != way:
            raise SystemExit(f"the code in {code} cannot read these recordings")

    return ask


if __name__ == "__main__":
    main()
