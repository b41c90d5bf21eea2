"""Write the demo: simulated needle insertions in every format, and a small Qwen2.5-VL.

Writes demo.episodes episodes in each of four formats to demo.recordings, about 160 MB, and a model
with random weights to demo.checkpoint. The same seed gives the same bytes. Finished recordings are
kept, an interrupted run leaves none, and a folder that the demo did not write is refused.

  python -m stages.demo                            as params.yaml stands
  python -m stages.demo --set demo.episodes=3      a quick look

Next: python -m stages.inspect (look at them), stages.extract (the store)
"""

from functools import partial
from typing import TYPE_CHECKING

from stages.command import run

if TYPE_CHECKING:
    from pipeline.base.config import Params

SECTIONS = ("demo",)


def main(params: "Params") -> None:
    """Write the recordings under `demo.recordings` and the checkpoint at `demo.checkpoint`."""
    from pipeline.base.files import recover_folder
    from pipeline.simulation.demo_recordings import DEMO, replace_demo, write_demo_recordings
    from pipeline.vlm.demo_checkpoint import write_checkpoint_files

    demo = params.demo
    recover_folder(demo.checkpoint, DEMO)
    write_demo_recordings(demo.recordings, demo.episodes, demo.seed)
    write = partial(write_checkpoint_files, seed=demo.seed)
    replace_demo(demo.checkpoint, {"seed": demo.seed}, write)
    print(f"{demo.episodes} episodes a format in {demo.recordings}, checkpoint {demo.checkpoint}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main, sections=SECTIONS))
