"""Every public name imports before any other of ours."""

import ast
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

SEEDS = {
    "pipeline.models": (
        "SensorEncoder",
        "ForceAwareSensorEncoder",
        "RobotStateEncoder",
        "RegressionActionExpert",
        "DiffusionActionExpert",
        "FlowMatchingActionExpert",
        "QwenVLAUnified",
        "QwenVLAWithSensorDiffusion",
        "QwenVLAWithSensor",
        "Not_freeze_QwenVLAWithSensor",
    ),
    "pipeline.datasets": (
        "UnifiedVLADataset",
        "unified_collate_fn",
        "create_unified_dataloader",
        "AsyncInsertionMeca500DatasetWithSensor",
        "NewAsyncInsertionDataset",
        "async_collate_fn_with_sensor",
        "create_weighted_async_dataloader",
    ),
}
"""The names that the old code's users know; each is a class or a function."""


def declared() -> dict[str, list[str]]:
    """`__all__` of every package that has one, read without importing it."""
    found: dict[str, list[str]] = {}
    for path in sorted(ROOT.glob("pipeline/**/__init__.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                found[".".join(path.parent.relative_to(ROOT).parts)] = ast.literal_eval(node.value)
    return found


DECLARED = declared()

IMPORTED = """
import json, os, sys
import dask.distributed, matplotlib.pyplot, peft, scipy.special, torch, zarr
import transformers.models.qwen2_5_vl.modeling_qwen2_5_vl
for module, names in json.loads(sys.argv[1]).items():
    if os.fork():
        _, status = os.wait()
        assert status == 0, module
        continue
    for name, known in names.items():
        exec(f"from {module} import {name} as it")
        assert callable(it) or not known, name
    os._exit(0)
"""
"""Each module in a process that has imported other people's packages and none of ours."""


def test_every_public_name_imports() -> None:
    names = {module: dict.fromkeys(listed, False) for module, listed in DECLARED.items()}
    for module, known in SEEDS.items():
        names[module] |= dict.fromkeys(known, True)
    command = [sys.executable, "-c", IMPORTED, json.dumps(names)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr


def test_packages_declare_what_people_import() -> None:
    for module in ("datasets", "models", "store"):
        assert DECLARED[f"pipeline.{module}"]
    assert {"Batch", "FeatureStore"} <= set(DECLARED["pipeline.store"])
    assert "Policy" in DECLARED["pipeline.models"]
