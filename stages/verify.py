"""Check a finished store: structure, files, the checksum of every row.

Reads every byte of verify.store (extract.store if null) and says what is wrong and where. The exit
code is 0 if the store is sound, else 2; then it lists all errors and what to run next.

  python -m stages.verify                   check
  python -m stages.verify --reextract 100   also compute 100 random rows again and compare them
  python -m stages.verify --repair          make the store again where it is damaged: sound rows are
                                            kept, the others are computed
  python -m stages.verify --checkpoint      no store: prove that the model of vlm gives the features
                                            that the head of train_head.output was trained on
  python -m stages.verify --checkpoint DIR  of another head

A damaged store stays until its repair is complete.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import Shorthand, run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("verify",)
SHORTHANDS = (
    Shorthand("--reextract", "verify.reextract", "random rows to compute again", value="N"),
    Shorthand("--repair", "verify.repair", "make a damaged store again; keep its sound rows"),
    Shorthand(
        "--checkpoint",
        "verify.checkpoint",
        "prove a checkpoint's golden rows instead",
        "FOLDER",
        "?",
    ),
)


def main(params: "Params") -> None:
    """Check the store, and repair it or compute rows again if requested; raises on errors."""
    from pipeline.base.errors import NumericsError, StoreIncomplete
    from pipeline.base.text import capped
    from pipeline.extract.row_check import reextract
    from pipeline.store.documents import mend
    from pipeline.store.verification import verify

    if params.verify.checkpoint:
        _prove(params)
        return
    store = params.verify.store or params.extract.store
    checked = verify(store)
    print(checked.summary())
    if not checked.sound:
        if not params.verify.repair:
            lines = [f"{store}: the store is damaged:", *checked.lines(), mend(store)]
            raise StoreIncomplete("\n".join(lines))
        print("\n".join(checked.lines()))
        _repair(store, params)
        return
    print(f"{store}: sound")
    if params.verify.reextract:
        computed = reextract(store, params, print)
        print("\n".join(computed.lines()))
        if computed.beyond:
            beyond = capped([str(row) for row in computed.beyond], "rows beyond the tolerance")
            lines = [f"{store}: rows are not what they would be today:", *beyond]
            raise NumericsError("\n".join(lines))


def _repair(store: Path, params: "Params") -> None:
    from pipeline.extract.run import extract

    own = params.extract.model_copy(update={"store": store, "plan": False})
    report = extract(params.model_copy(update={"extract": own}), print, repair=True)
    if report is not None:
        print(f"{store}: repaired: " + "\n".join(report.lines()))


def _prove(params: "Params") -> None:
    """Compute the checkpoint's golden rows again, on the same device as `stages.serve`."""
    from pipeline.base.hardware import resolve_device
    from pipeline.policy.checkpoint import find_policy, load_policy
    from pipeline.robot.live_features import LiveFeatures, prove

    named = params.verify.checkpoint
    folder = find_policy(params.train_head.output if named in (None, True) else named)
    checkpoint, device = load_policy(folder), resolve_device(params.serve.device)
    trained, say = checkpoint.source["feature_spec"], partial(print, flush=True)
    if "features" not in checkpoint.policy().encoders:
        say(f"{folder} (step {checkpoint.step}): looks at no features, so nothing is to be proved")
        return
    say(f"{folder} (step {checkpoint.step}): {len(checkpoint.golden)} golden rows, {device}")
    prove(checkpoint, LiveFeatures(params.vlm, trained, str(device)), say)


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
