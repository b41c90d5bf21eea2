"""Write the head of a trained policy, all but the vision-language model, for other runtimes.

Reads what stages.train_head wrote to train_head.output, or export.checkpoint if it is set. Writes
head.onnx (ONNX Runtime) and head.pt2 (torch.export.load) into `export.output`; both run without
this project. Also writes receipt.json: inputs and outputs with their units, digests, and how far
the answers of each file are from the policy's. If they are too far, the export is refused and the
earlier files stay.

  python -m stages.export
  python -m stages.export --set export.formats=[torch]         without ONNX's packages
"""

from functools import partial
from typing import TYPE_CHECKING

from stages.command import run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("export",)
SHORTHANDS = short("export", "--checkpoint", "--out")


def main(params: "Params") -> None:
    """Export the checkpoint that `export` names, else what `train_head` wrote."""
    from pipeline.base.files import refuse_foreign
    from pipeline.policy.checkpoint import find_policy, load_policy
    from pipeline.robot.export import EXPORT, RECEIPT, export_head

    wanted, say = params.export, partial(print, flush=True)
    refuse_foreign(wanted.output, EXPORT)
    folder = wanted.checkpoint or params.train_head.output
    checkpoint = load_policy(find_policy(folder))
    receipt = export_head(checkpoint, str(folder), wanted, say)
    for name, file in receipt["files"].items():
        off = ", ".join(f"{by['std']:.1e} ({inputs})" for inputs, by in file["deviation"].items())
        say(f"{name}: {file['bytes'] / 1e6:.1f} MB, at most {off} training std off the policy")
    say(f"{wanted.output}: {', '.join(receipt['files'])}, {RECEIPT}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
