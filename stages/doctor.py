"""Check this machine: what is there, what is missing, and what to install or set.

Checks Python and packages, the GPU, torch's build and the attention backend, the checkpoint, the
recordings and their videos, for the given params. It downloads nothing, loads no model and changes
nothing; it takes some seconds. For the room that the store needs, run python -m stages.extract
--set extract.plan=true; for what DVC has and how it links, run dvc doctor.

  python -m stages.doctor                                        as params.yaml stands
  python -m stages.doctor --set vlm.checkpoint=Qwen/Qwen2.5-VL-3B-Instruct --set data.root=/lab

  ok        as it should be
  note      works, but could be better, or is needed later
  missing   the default pipeline does not run with these params; the text after -> says what to do

The exit code is 2 if something is missing. Next: python -m stages.extract --set extract.plan=true
"""

from typing import TYPE_CHECKING

from stages.command import run

if TYPE_CHECKING:
    from pipeline.base.config import Params
    from pipeline.base.errors import Issue

SECTIONS = ("data", "vlm", "extract", "train_head")


def main(params: "Params") -> None:
    """Print every group of issues; raise `PipelineError` if something is missing."""
    from pipeline.base.errors import PipelineError
    from pipeline.base.printed_commands import command
    from pipeline.look.doctor import describe, examine

    lacking: list[Issue] = []
    for title, issues in examine(params):
        print("\n".join(describe(title, issues)), flush=True)
        lacking += [issue for issue in issues if issue.severity == "error"]
    if lacking:
        subjects = ", ".join(dict.fromkeys(issue.kind for issue in lacking))
        raise PipelineError(
            f"{len(lacking)} thing(s) are missing: {subjects}. Do what stands behind -> there, "
            f"then run {command('doctor')} again."
        )
    print("nothing that was looked at is missing; to read every episode, run")
    print(f"  {command('extract', '--set extract.plan=true')}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=SECTIONS))
