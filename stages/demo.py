"""Write the demo: simulated needle insertions in every format, and a small Qwen2.5-VL.

The same seed gives the same bytes. Finished sets are kept, an interrupted run goes on with the
others, and a folder that the demo did not write is refused.
"""

from pipeline.config import Params
from pipeline.simulation.demo_recordings import write_demo_recordings
from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from stages.command import run


def main(params: Params) -> None:
    """The recordings under `demo.recordings`, the checkpoint at `demo.checkpoint`."""
    demo = params.demo
    write_demo_recordings(demo.recordings, demo.episodes, demo.seed)
    write_demo_checkpoint(demo.checkpoint, demo.seed)
    print(f"{demo.episodes} episodes a format in {demo.recordings}, checkpoint {demo.checkpoint}")


if __name__ == "__main__":
    raise SystemExit(run(__doc__ or "", main))
