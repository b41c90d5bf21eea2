"""The pages of the reference: one a room, made of its docstrings.

A package shows what its `__all__` offers, where it is defined; one that offers its modules instead
shows each of them in full. So do the modules that a recipe sends the reader to. A name that another
package defines is a link.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = "pipeline.base.config"
"""`params.md` says it better."""
IN_FULL = {"data": ("discovery", "recording", "timeline"), "store": ("schema", "reader", "gather")}
"""Modules of a package that are shown in full, beside what its `__all__` offers."""


@cache
def reference_pages() -> dict[str, str]:
    """Text by path of every page but the index, in the order of the navigation."""
    pages = {f"reference/{room}.md": _room_page(room) for room in rooms()}
    return {"reference/commands.md": _commands_page(), **pages}


def rooms() -> list[str]:
    """Packages of `pipeline`: each has a page."""
    return sorted(path.parent.name for path in (ROOT / "pipeline").glob("*/__init__.py"))


def _room_page(room: str) -> str:
    package = ROOT / "pipeline" / room
    homes = _offered(package / "__init__.py")
    in_full = [f"pipeline.{room}.{name}" for name in IN_FULL.get(room, ())]
    if not homes:
        in_full = [name for name in _modules(package) if not name.startswith(LEFT_OUT)]
    blocks = [_block(f"pipeline.{room}", docstring_only=True), *map(_block, in_full)]
    own = f"pipeline.{room}."
    for name, home in homes.items():
        if not home.startswith(own):
            blocks.append(f"- [`{name}`][{home}.{name}]")
        elif home not in in_full:
            blocks.append(_block(f"{home}.{name}"))
    return "\n".join([f"# {room}\n", *blocks])


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


def _block(path: str, *, docstring_only: bool = False) -> str:
    """What mkdocstrings replaces by the documentation of an object."""
    options = ["heading_level: 2"]
    if docstring_only:
        options += ["show_root_heading: false", "show_root_toc_entry: false", "members: false"]
    lines = "".join(f"        {option}\n" for option in options)
    return f"::: {path}\n    options:\n{lines}"


def _modules(package: Path) -> Iterator[str]:
    """The dotted names of a package's modules, those of packages in it too."""
    for path in sorted(package.rglob("*.py")):
        if path.stem != "__init__":
            yield ".".join(path.relative_to(ROOT).with_suffix("").parts)


def _offered(init: Path) -> dict[str, str]:
    """The names in a package's `__all__`, and the module that each is imported from."""
    tree = ast.parse(init.read_text(encoding="utf-8"))
    imported = {
        alias.asname or alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    names = [
        name
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        for name in ast.literal_eval(node.value)
    ]
    return {name: imported[name] for name in names if name in imported}
