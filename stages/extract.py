"""Run the frozen vision-language model over recordings once and keep its features in a store.

Reads recordings (camera frames, force, A-scan, robot state, actions) and a Qwen2.5-VL checkpoint.
Writes one zarr store, which is all that training needs: pooled features of the model for every
vlm_reuse_count-th control tick, and the raw streams. The given params.yaml extracts the demo.

  python -m stages.doctor                              is this machine ready, does the store fit
  python -m stages.extract --set extract.plan=true     how many rows, how large, how long, and why
  python -m stages.extract                             do it

For your own recordings set these in params.yaml, or with --set:
  data.root         /recordings                         the folder that DVC watches
  data.sources      [{name: lab, path: 2025-*}]         in it: episodes, folders of such, LeRobot
  data.action_hz    10                                  control ticks a second; null: as recorded
  vlm.checkpoint    Qwen/Qwen2.5-VL-3B-Instruct         or its folder; and with a real model
                    vlm.dtype: bfloat16, vlm.image_resize_height: 360, vlm.image_resize_width: 640
  extract.store     cache_store/lab.zarr

All episodes are read and checked first, and all errors are listed before anything is computed. You
can stop at any time: the same command continues. If nothing changed, a finished store stays as it
is; if recordings were added, only their rows are computed. extract.batch_size and workers change no
feature.

Next: python -m stages.inspect STORE (look at it), stages.train_head (train). docs/ says the rest.
"""

from typing import TYPE_CHECKING

from stages.command import Shorthand, run, short

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("data", "vlm", "extract")
SHORTHANDS = (
    *short("data", "--data", "--views"),
    *short("extract", "--store", "--batch", "--device"),
    Shorthand("--plan", "extract.plan", "say what would be computed, and why; compute nothing"),
)


def main(params: "Params") -> None:
    """Extract and report."""
    from pipeline.extract.run import extract

    report = extract(params, say=print)
    if report is not None:
        print(f"{params.extract.store}: " + "\n".join(report.lines()))


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, shorthands=SHORTHANDS, sections=SECTIONS))
