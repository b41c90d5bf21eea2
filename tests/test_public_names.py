"""Every public name imports before any other of ours."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

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
NAMES = {
    module: sorted({*DECLARED.get(module, ()), *SEEDS.get(module, ())})
    for module in sorted({*DECLARED, *SEEDS})
}

IMPORTED = """
import json, os, sys
import dask.distributed, matplotlib.pyplot, peft, scipy.special, torch, zarr
import transformers.models.qwen2_5_vl.modeling_qwen2_5_vl
for module, names in json.loads(sys.argv[1]).items():
    if os.fork():
        _, status = os.wait()
        assert status == 0, module
        continue
    found = {}
    for name in names:
        try:
            exec(f"from {module} import {name} as it")
            found[name] = "callable" if callable(it) else "a value"
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
    print(json.dumps({module: found}), flush=True)
    os._exit(0)
"""
"""Each module in a process that has imported other people's packages and none of ours."""


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, timeout=120
    )


@pytest.fixture(scope="module")
def imported() -> dict[str, dict[str, str]]:
    """By module, what each public name is, or why it does not import."""
    done = python("-c", IMPORTED, json.dumps(NAMES))
    assert done.returncode == 0, done.stderr
    found: dict[str, dict[str, str]] = {}
    for line in done.stdout.splitlines():
        found |= json.loads(line)
    return found


def test_every_public_name_imports(imported: dict[str, dict[str, str]]) -> None:
    wrong = {
        (module, name): is_it
        for module, names in NAMES.items()
        for name in names
        if (is_it := imported[module][name]) != "callable"
        and (name in SEEDS.get(module, ()) or is_it != "a value")
    }
    assert not wrong


def test_packages_declare_what_people_import() -> None:
    for module in ("datasets", "models", "store"):
        assert DECLARED[f"pipeline.{module}"]
    assert {"Batch", "FeatureStore"} <= set(DECLARED["pipeline.store"])
    assert "Policy" in DECLARED["pipeline.models"]
