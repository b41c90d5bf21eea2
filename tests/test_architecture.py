"""The picture of the house is true: who imports whom, and what each stage declares to DVC."""

import ast
from functools import cache
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]

TIERS = (
    {"base"},
    {"data", "vlm", "store", "policy"},
    {"extract", "train", "simulation"},
    {"robot"},
    {"evaluate"},
    {"look", "compat"},
    {"models", "datasets"},
)
"""Rooms import from tiers above theirs in this list, and from themselves."""

ONLY_IN = {
    "transformers": {"vlm"},
    "peft": {"vlm"},
    "zarr": {"store"},
    "numcodecs": {"store"},
    "yaml": {"base"},
    "sklearn": {"evaluate"},
    "matplotlib": {"look"},
    "jinja2": {"look"},
    "gymnasium": {"simulation"},
    "websockets": {"robot"},
    "msgpack": {"robot"},
}
WITHOUT_TORCH = {"data"}
STAGE_ONE = {"vlm", "data", "extract", "simulation"}
"""Rooms that stage two runs without, except fine-tuning."""


def modules() -> dict[str, Path]:
    """Every module of `pipeline` and `stages` by dotted name."""
    by_name = {}
    for path in sorted([*ROOT.glob("pipeline/**/*.py"), *ROOT.glob("stages/**/*.py")]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        by_name[".".join(part for part in parts if part != "__init__")] = path
    return by_name


MODULES = modules()


@cache
def imports(module: str) -> frozenset[str]:
    """What a module imports anywhere in its text, as modules of the project or top-level names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            base = node.module or ""
            names |= {
                full if (full := f"{base}.{alias.name}") in MODULES else base
                for alias in node.names
            }
    return frozenset(names)


def room(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def test_a_room_imports_only_from_rooms_below():
    tier = {name: level for level, names in enumerate(TIERS) for name in names}
    pipeline = [name for name in MODULES if name.startswith("pipeline.")]
    assert {room(name) for name in pipeline} == tier.keys()
    for module, imported in [(user, name) for user in pipeline for name in imports(user)]:
        assert not imported.startswith("stages"), f"{module} imports {imported}"
        if imported.startswith("pipeline.") and room(imported) != room(module):
            assert tier[room(imported)] < tier[room(module)], f"{module} imports {imported}"
            if room(module) == "train" and not module.startswith("pipeline.train.finetuning"):
                assert room(imported) not in STAGE_ONE, f"{module} imports {imported}"


def test_no_circle_of_files_exists():
    """Lazy imports count, too: a file is below another, above it, or knows nothing of it."""
    left = set(MODULES)
    while left:
        used = {name for module in left for name in imports(module) & left}
        ends = {module for module in left if module not in used or not imports(module) & left}
        assert ends, f"files in circles, or between two of them: {sorted(left)}"
        left -= ends


def test_heavy_libraries_stay_in_their_rooms():
    for module in MODULES:
        for top in {imported.split(".")[0] for imported in imports(module)}:
            assert room(module) in ONLY_IN.get(top, {room(module)}), f"{module} imports {top}"
            assert top != "torch" or room(module) not in WITHOUT_TORCH, f"{module} imports torch"


def test_nothing_is_loaded_that_could_run_its_own_code():
    """peft's loaders know no `trust_remote_code` and run nothing of an adapter's folder."""
    paths = [*MODULES.values(), *(ROOT / "benchmarks").rglob("*.py")]
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)) if ".from_pretrained" in text else ():
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".from_pretrained"):
                keywords = {word.arg: ast.unparse(word.value) for word in node.keywords}
                from_peft = ast.unparse(node.func).startswith("Peft")
                safe = from_peft or keywords.get("trust_remote_code") == "False"
                assert safe, f"{path}:{node.lineno}"


def reached(module: str) -> set[str]:
    """The project's modules that importing this one runs, packages on the way included."""
    names: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in MODULES and name not in names:
            names.add(name)
            waiting += [*imports(name), name.rpartition(".")[0]]
    return names


def has_code(path: Path) -> bool:
    """Whether a module is more than a docstring."""
    return any(
        not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
    )


@pytest.mark.parametrize("stage", ["demo", "extract", "train_head", "evaluate", "rollout"])
def test_every_module_a_stage_runs_is_among_its_deps(stage):
    document = yaml.safe_load((ROOT / "dvc.yaml").read_text())["stages"][stage]
    assert f"python -m stages.{stage}" in document["cmd"]
    deps = {(ROOT / dep).resolve() for dep in document["deps"] if "$" not in dep}
    needed = set()
    for name in reached(f"stages.{stage}"):
        path = MODULES[name]
        if has_code(path):
            covering = {dep for dep in deps if dep == path or dep in path.parents}
            assert covering, f"{path.relative_to(ROOT)} is not among the deps of {stage}"
            needed |= covering
    assert deps == needed, f"{stage} does not need {[str(dep) for dep in deps - needed]}"


def test_stage_two_knows_nothing_of_stage_one():
    """Except that the report of an evaluation shows frames, which only recordings have."""
    shown = {"train_head": set(), "evaluate": {"data"}}
    for stage, known in shown.items():
        rooms = {room(name) for name in reached(f"stages.{stage}") if name.startswith("pipeline.")}
        assert rooms & STAGE_ONE == known


def test_only_one_module_removes_folders():
    """It refuses those that are not this project's."""
    texts = {name: path.read_text(encoding="utf-8") for name, path in MODULES.items()}
    assert [name for name in texts if "rmtree" in texts[name]] == ["pipeline.base.files"]
