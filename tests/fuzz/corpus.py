"""One small real thing of every kind that the pipeline reads, written by the project's own writers.

`other/` holds a second recording of each format, to take files from that belong elsewhere.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from peft import LoraConfig, get_peft_model
from transformers import Qwen2_5_VLForConditionalGeneration

from pipeline.vlm.demo_checkpoint import write_demo_checkpoint
from stages import archive, extract, train_head
from stages.command import run
from tests.data.conftest import START, Truth, write_lerobot, write_new, write_old, write_raw

TASK = "Touch_the_dot"
RECORDINGS = ("raw", "new", "old", "lerobot_v21", "lerobot_v30", "lerobot_images")
BEGIN = 1762581311.75
"""A quarter of a second before a clock of float32 goes 128 s on."""
STORE, ARCHIVE, HEAD = "store.zarr", "archive.zarr", "head"


def write_corpus(root: Path) -> None:
    """Recordings, a checkpoint, an adapter, a store, its archive and a head."""
    write_recordings(root, seed=0)
    write_recordings(root / "other", seed=1)
    write_model(root)
    (root / "params.yaml").write_text(yaml.safe_dump(params(root, "lerobot_images", root)))
    for stage in (extract, archive, train_head):
        code = run("", stage.main, ["--params", str(root / "params.yaml")])
        assert code == 0, f"{stage.__name__} cannot make the corpus"


def params(root: Path, subject: str, case: Path) -> dict[str, Any]:
    """The params of a case in its folder: what it has not of its own is the corpus's."""
    small = {"dim": 8, "layers": 1, "heads": 1}
    return {
        "data": {
            "root": str(case),
            "sources": [{"name": "one", "path": subject}],
            "action_hz": 10,
            "vlm_reuse_count": 3,
        },
        "vlm": {
            "checkpoint": str(root / "vlm"),
            "dtype": "float32",
            "image_resize_height": 56,
            "image_resize_width": 56,
        },
        "extract": {"store": str(case / STORE), "batch_size": 4, "device": "cpu"},
        "archive": {"output": str(case / ARCHIVE), "threads": 1},
        "train_head": {
            "sensor_encoder": {"channels": [4], "layers": 0, "heads": 1, "output_dim": 4},
            "state_encoder": {"dim": 4, "layers": 0, "heads": 1, "output_dim": 4},
            "expert": small,
            "horizon": 2,
            "sensor_window": 6,
            "state_window": 5,
            "batch_size": 4,
            "max_steps": 1,
            "warmup_steps": 0,
            "device": "cpu",
            "output": str(case / HEAD),
            "logs": str(case / "logs"),
        },
        "evaluate": {"device": "cpu", "output": str(case / "evaluation")},
    }


def write_recordings(root: Path, seed: int) -> None:
    """An episode of each of the recorder's formats, and LeRobot data sets of three each."""
    truth = Truth(np.random.default_rng(seed))
    for clock in (truth.state_time, truth.sensor_time, truth.frame_time):
        clock += BEGIN - START
    write_raw(root / "raw" / TASK / "episode", truth)
    group = {"start_time": BEGIN, "end_time": BEGIN + 0.5, "group": "monday"}
    write_new(root / "new" / TASK / "episode", truth, metadata=group)
    old = write_old(root / "old" / TASK / "episode", truth)
    np.savez(old / "robot_states.npz", robot_states=truth.state)
    write_lerobot(root / "lerobot_v21")
    write_lerobot(root / "lerobot_v30", "v3.0", file_of=(0, 0, 1))
    images = write_lerobot(root / "lerobot_images", "v3.0", image=True)
    for index, rows in enumerate((7, 5, 9)):
        _write_sidecars(images, f"episode_{index:06d}.npz", rows, truth.rng)


def _write_sidecars(root: Path, name: str, rows: int, rng: np.random.Generator) -> None:
    named = {
        "sensor": {"names": ["force", "depth"], "units": ["N", "mm"]},
        "state": {"names": ["a", "b", "c"], "units": ["deg", "deg", ""]},
    }
    for late, (folder, described) in enumerate(named.items()):
        clock = np.arange(8 * rows) / 80 - 0.02 + 0.001 * late
        (root / folder).mkdir(exist_ok=True)
        np.savez(
            root / folder / name,
            timestamps=clock,
            values=rng.normal(size=(len(clock), len(described["names"]))).astype(np.float32),
            **{key: np.array(words) for key, words in described.items()},
        )


def write_model(root: Path) -> None:
    """The demo's checkpoint, a second one of other weights, and a LoRA adapter of the first."""
    write_demo_checkpoint(root / "vlm")
    write_demo_checkpoint(root / "other" / "vlm", seed=1)
    for seed, folder in enumerate((root, root / "other")):
        base = Qwen2_5_VLForConditionalGeneration.from_pretrained(folder / "vlm")
        adapted: Any = get_peft_model(
            base, LoraConfig(r=2 + seed, target_modules=["q_proj", "v_proj"])
        )
        adapted.save_pretrained(folder / "adapter")
