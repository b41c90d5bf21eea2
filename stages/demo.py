"""Write the demo: simulated needle insertions in every format, and a small Qwen2.5-VL.

Writes demo.episodes episodes in each of four formats to demo.recordings, about 60 MB, and a model
with random weights to demo.checkpoint. The same seed gives the same bytes. Finished sets are kept,
an interrupted run continues with the others, and a folder that the demo did not write is refused.

  python -m stages.demo                            as params.yaml stands
  python -m stages.demo --set demo.episodes=3      a quick look

Next: python -m stages.inspect (look at them), stages.extract (the store)
"""

from pathlib import Path
from typing import TYPE_CHECKING

from stages.command import run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("demo",)


def main(params: "Params") -> None:
    """Write the recordings under `demo.recordings` and the checkpoint at `demo.checkpoint`."""
    from pipeline.base.files import recover_folder, replace_folder, write_document
    from pipeline.simulation.demo_recordings import (
        DEMO,
        MARKER,
        contents_digest,
        refuse_changed_checkpoint,
        refuse_foreign,
        write_demo_recordings,
    )
    from pipeline.vlm.demo_checkpoint import write_demo_checkpoint

    demo = params.demo
    refuse_foreign(demo.checkpoint, "demo.checkpoint")
    recover_folder(demo.checkpoint, DEMO)
    write_demo_recordings(demo.recordings, demo.episodes, demo.seed)

    def write_marked(folder: Path) -> None:
        write_demo_checkpoint(folder, demo.seed)
        contents = {"": contents_digest(folder)}
        write_document(folder / MARKER, {"seed": demo.seed, "contents": contents})

    refuse_changed_checkpoint(demo.checkpoint)
    replace_folder(demo.checkpoint, write_marked, DEMO)
    print(f"{demo.episodes} episodes a format in {demo.recordings}, checkpoint {demo.checkpoint}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=SECTIONS))
