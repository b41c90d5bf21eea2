"""Break files of every kind, run commands on them, and print the table of how that ended.

python -m tests.fuzz.table --cases 10000 --seed 1
python -m tests.fuzz.table --seed 1 --case 77 --corpus DIR   one case; keeps its folder beside DIR

How it works:
1. corpus.py writes one small thing of every kind that commands read: recordings of each format, a
   checkpoint, an adapter, a store, its archive and a head.
2. cases.py chooses, by the seed and the case's number alone: a thing, what is done to it, and the
   command that reads it. The thing is laid into a folder of its own, in hard links.
3. mutations.py has what may be done to a file, by the kind of file. Each change says what may come
   of it where the command ends with 0.
4. runner.py forks a process for each case from one that has imported everything, and limits it to
   10 s and 2 GiB.
5. oracle.py judges. After exit 0, what was read must be as before where the change permits nothing
   else. After exit 2, one message must name the file and say what to do. Whatever else happens is
   a failure.
6. Whatever lies in the corpus must first be right as it is.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
os.environ |= {"TOKENIZERS_PARALLELISM": "false", "HF_HUB_OFFLINE": "1"}

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.cases import CLASSES, Case, wholes
from tests.fuzz.corpus import write_corpus
from tests.fuzz.runner import OUTCOMES, Verdict, in_child, run_cases, warm

HEADS = ("read", "refused clearly", "failed")


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit 1 where a case ended in another way than the rule allows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="run this one alone")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--corpus", type=Path, help="where it is, or is to be made and kept")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        corpus = (options.corpus or Path(folder) / "corpus").absolute()
        prepare(corpus, options.jobs)
        numbers = range(options.cases) if options.case is None else [options.case]
        cases = [Case(options.seed, number, corpus) for number in numbers]
        verdicts = []
        for verdict in run_cases(cases, options.jobs, keep=options.case is not None):
            verdicts.append(verdict)
            if options.case is not None or not verdict.good:
                print(verdict, file=sys.stderr, flush=True)
    print("\n".join(rows(verdicts)))
    return not all(verdict.good for verdict in verdicts)


def prepare(corpus: Path, jobs: int) -> None:
    """Import, write the corpus where it is not there, and see that it is read rightly as it is."""
    warm()
    if not (corpus / "ready").exists():
        in_child(lambda: write_corpus(corpus))
        wrong = [str(v) for v in run_cases(wholes(corpus), jobs) if v.outcome != "right"]
        assert not wrong, "\n".join(["what is as it was written is not read rightly:", *wrong])
        (corpus / "ready").touch()


def rows(verdicts: Sequence[Verdict]) -> list[str]:
    """The table in Markdown."""
    counts = Counter((verdict.case.kind, verdict.outcome) for verdict in verdicts)
    lines = [f"| | tried | {' | '.join(HEADS)} |", f"|---|{'---:|' * (len(HEADS) + 1)}"]
    for kind in (*CLASSES, "all"):
        kinds = CLASSES if kind == "all" else (kind,)
        right, clear, *failed = (sum(counts[one, outcome] for one in kinds) for outcome in OUTCOMES)
        numbers = [right, clear, sum(failed)]
        lines.append(f"| {kind} | {sum(numbers)} | {' | '.join(map(str, numbers))} |")
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
