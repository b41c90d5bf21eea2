"""The pages of the reference: one a room, made of its docstrings.

A package shows what its `__all__` offers, where it is defined; one that offers its modules instead
shows each of them in full. So do the modules that a recipe sends the reader to.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = {"config"}
"""`params.md` says it better."""
IN_FULL = {
    "recordings": ("reader", "recording"),
    "models": ("expert", "policy"),
    "store": ("schema", "reader", "batch"),
    "plots": ("interactive", "recording.lanes", "store", "store_features"),
    "report": (
        "evaluation.comparison",
        "evaluation.evaluation",
        "inspection.recording",
        "inspection.store",
    ),
}
"""Modules of a package that are shown in full, beside what its `__all__` offers."""


@cache
def reference_pages() -> dict[str, str]:
    """Text by path of every page but the index, in the order of the navigation."""
    pages = {f"reference/{room}.md": _room_page(room) for room in rooms()}
    return {"reference/commands.md": _commands_page(), **pages}


def rooms() -> list[str]:
    """Packages and modules of `pipeline` that have a page."""
    found = (
        path.stem
        for path in sorted((ROOT / "pipeline").iterdir())
        if path.suffix == ".py" or (path / "__init__.py").exists()
    )
    return [name for name in found if name != "__init__" and name not in LEFT_OUT]


def _room_page(room: str) -> str:
    package = ROOT / "pipeline" / room / "__init__.py"
    title = f"# {room}\n"
    if not package.exists():
        return f"{title}\n{_block(f'pipeline.{room}', nested=False)}"
    modules = _modules(package.parent)
    offered = _offered(package.parent)
    in_full = IN_FULL.get(room, ()) if offered else tuple(_public(modules))
    blocks = [_block(f"pipeline.{room}", docstring_only=True)]
    for name in in_full:
        blocks.append(_block(f"pipeline.{room}.{name}"))
    for name in offered:
        module = _home(name, modules)
        if module is not None and module not in in_full:
            blocks.append(_block(".".join(filter(None, ["pipeline", room, module, name]))))
    return "\n".join([title, *blocks])


def _commands_page() -> str:
    stages = sorted(path.stem for path in (ROOT / "stages").glob("*.py"))
    commands = [name for name in stages if name not in ("__init__", "command")]
    blocks = [
        f"## python -m stages.{name}\n\n{_block(f'stages.{name}', docstring_only=True)}"
        for name in commands
    ]
    introduction = (
        "Every command takes `--params FILE`, `--set section.key=value` (as often as you like),"
        " `--keys` and `--help`. It ends with 0; with 2 and one message for what you can mend;"
        " with 1 when it was stopped or has a bug.\n"
    )
    return "\n".join(["# commands\n", introduction, *blocks])


def _block(path: str, *, docstring_only: bool = False, nested: bool = True) -> str:
    """What mkdocstrings replaces by the documentation of an object."""
    options = ["heading_level: 2"]
    if docstring_only or not nested:
        options += ["show_root_heading: false", "show_root_toc_entry: false"]
    if docstring_only:
        options.append("members: false")
    lines = "".join(f"        {option}\n" for option in options)
    return f"::: {path}\n    options:\n{lines}"


def _modules(package: Path) -> dict[str, set[str]]:
    """What each module defines at its top level, by its dotted name; the package's own is ''."""
    return {
        _dotted(path.relative_to(package)): set(_defined(path))
        for path in sorted(package.rglob("*.py"))
    }


def _dotted(path: Path) -> str:
    parts = path.parent.parts if path.stem == "__init__" else path.with_suffix("").parts
    return ".".join(parts)


def _public(modules: dict[str, set[str]]) -> Iterator[str]:
    return (name for name in modules if name and not name.startswith("_"))


def _home(name: str, modules: dict[str, set[str]]) -> str | None:
    """The module that defines a name; None where it comes from another room."""
    return next((module for module, defined in modules.items() if name in defined), None)


def _defined(path: Path) -> Iterator[str]:
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id


def _offered(package: Path) -> list[str]:
    """The names in `__all__` of a package, and of packages in it."""
    return [
        name
        for path in sorted(package.rglob("__init__.py"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        for name in ast.literal_eval(node.value)
    ]
