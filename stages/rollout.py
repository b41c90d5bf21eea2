"""Run a trained policy closed loop in a simulation, and count its successes.

Reads what stages.train_head wrote to train_head.output, or rollout.checkpoint if it is set, and the
model of vlm.checkpoint, which must give the features that the policy was trained on. For comparison
it also runs the demonstrator, and the policy without sensor and without features (or what
rollout.ablations says). Writes metrics.json (success with its 95 % interval), headline.json (the
policy's success alone, for `dvc metrics show`), episodes.csv (the policy's episodes), beside.csv
(the others), settings.json and a page (report.html) into `rollout.output`.

  python -m stages.rollout                                     50 episodes at level full
  python -m stages.rollout --set rollout.level=moved           the target is pushed meanwhile
  python -m stages.rollout --set rollout.environment=metaworld:assembly-v3   a task of Meta-World
  python -m stages.rollout --set rollout.chunking=none         another way to play chunks
  python -m stages.rollout --set 'rollout.latency_ms=[0, 300, 600]'   success against latency
  python -m stages.rollout --set rollout.server=ws://127.0.0.1:8000   what stages.serve answers
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params, RolloutParams
    from pipeline.evaluate.rollouts import Rollouts

SECTIONS = ("rollout",)
SHORTHANDS = short("rollout", "--checkpoint", "--out", "--device")


def main(params: "Params") -> None:
    """Run the checkpoint that `rollout` names, else what `train_head` wrote."""
    from pipeline.base.files import REPORT, refuse_foreign

    wanted = params.rollout
    refuse_foreign(wanted.output, REPORT)
    if wanted.environment is None:
        _write_nothing(wanted.output)
        print("nothing is rolled out, as rollout.environment is null")
        return
    say = partial(print, flush=True)
    rollouts = _served(wanted, say) if wanted.server else _here(params, say)
    files = _write(wanted.output, rollouts)
    for line in rollouts.summary().text():
        print(line)
    print(f"{wanted.output}: {', '.join(file.name for file in files)}")


def _write_nothing(folder: Path) -> None:
    """Write a page that says that there are no rollouts, in place of earlier results."""
    from pipeline.base.files import REPORT, claim, write_document
    from pipeline.look.page.blocks import Report
    from pipeline.look.page.writing import write_report

    claim(folder, REPORT)
    for name in ("settings.json", "episodes.csv", "beside.csv"):
        (folder / name).unlink(missing_ok=True)
    write_document(folder / "metrics.json", {"success": {}})
    write_document(folder / "headline.json", {})
    write_report(folder, Report("No rollouts", "`rollout.environment` is null.", (), ()))


def _here(params: "Params", say: Callable[[str], None]) -> "Rollouts":
    """The rollouts of a checkpoint, with the model in this process."""
    from pipeline.base.hardware import resolve_device
    from pipeline.evaluate.rollout_driver import roll_out
    from pipeline.policy.checkpoint import find_policy, load_policy
    from pipeline.robot.live_features import LiveFeatures

    wanted = params.rollout
    folder = wanted.checkpoint or params.train_head.output
    checkpoint = load_policy(find_policy(folder))
    device = resolve_device(wanted.device)
    trained = checkpoint.source["feature_spec"]
    load = partial(LiveFeatures, params.vlm, trained, str(device), checkpoint.basis)
    say(f"{folder} (step {checkpoint.step}), {_where(wanted)}, device {device}")
    return roll_out(checkpoint, str(folder), checkpoint.policy(device), load, wanted, say)


def _served(wanted: "RolloutParams", say: Callable[[str], None]) -> "Rollouts":
    """The rollouts of the policy that `rollout.server` serves."""
    from pipeline.evaluate.rollout_driver import roll_out_served
    from pipeline.robot.client import TOKEN_VARIABLE, PolicyClient

    assert wanted.server is not None
    with PolicyClient(wanted.server, token=os.environ.get(TOKEN_VARIABLE)) as server:
        policy = server.metadata
        name, step = policy["checkpoint"], policy["step"]
        say(f"{wanted.server}: {name} (step {step}), {_where(wanted)}")
        return roll_out_served(server, wanted, say)


def _where(wanted: "RolloutParams") -> str:
    from pipeline.base.config import PHANTOM, environments

    names = environments(wanted.environment)
    return f"level {wanted.level}" if names == (PHANTOM,) else ", ".join(names)


def _write(folder: Path, rollouts: "Rollouts") -> list[Path]:
    """Write metrics, tables of episodes and the page; returns their paths."""
    from pipeline.base.files import REPORT, claim, write_document
    from pipeline.evaluate.rollouts import POLICY
    from pipeline.look.page.writing import write_report
    from pipeline.look.rollout import rollout_report

    claim(folder, REPORT)
    write_document(folder / "metrics.json", rollouts.document())
    write_document(folder / "headline.json", {"success": rollouts.rates()[POLICY].rate})
    write_document(folder / "settings.json", dict(rollouts.settings))
    tables = [
        rollouts.table(policy=True).write_csv(folder / "episodes.csv"),
        rollouts.table(policy=False).write_csv(folder / "beside.csv"),
    ]
    return [
        *(folder / f"{name}.json" for name in ("metrics", "headline", "settings")),
        *tables,
        *write_report(folder, rollout_report(rollouts)),
    ]


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
