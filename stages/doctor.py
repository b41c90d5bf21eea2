"""Look at this machine: what is there, what is missing, and what to install or set.

Checks Python and packages, the GPU and torch's build, attention backends, video decoders, the
checkpoint, the recordings, the room for the store, DVC's cache and the kernel's limits, for the
params given. Downloads nothing, loads no model, changes nothing; takes some seconds.

  python -m stages.doctor                                        as params.yaml stands
  python -m stages.doctor --set vlm.checkpoint=Qwen/Qwen2.5-VL-3B-Instruct --set data.root=/lab

  ok        as it should be
  note      works, but could be better, or is needed later
  missing   the default pipeline does not run with these params; -> says what mends it

Exit code 2 where something is missing. Next: python -m stages.extract --set extract.plan=true
"""

from stages.command import run

if __name__ == "__main__":  # here, for --help waits for no import below
    raise SystemExit(
        run(__doc__ or "", "stages.doctor", sections=("data", "vlm", "extract", "train_head"))
    )

from pipeline.base.config import Params
from pipeline.base.errors import PipelineError
from pipeline.look.doctor import Finding, described, examine


def main(params: Params) -> None:
    """Print every group of findings; refuse where one is missing."""
    lacking: list[Finding] = []
    for title, findings in examine(params):
        print("\n".join(described(title, findings)), flush=True)
        lacking += [finding for finding in findings if finding.level == "missing"]
    if lacking:
        subjects = ", ".join(dict.fromkeys(finding.subject for finding in lacking))
        raise PipelineError(
            f"{len(lacking)} thing(s) are missing: {subjects}. Do what stands behind -> there, "
            "then run python -m stages.doctor again."
        )
    print(
        "nothing that was looked at is missing; python -m stages.extract --set extract.plan=true "
        "reads every episode"
    )
