"""What code a step depends on, as one short hash: a step re-runs when, and only when, code that it imports has changed.

Snakemake sees the command `python -m avatar.train`, not what the module imports. So every rule carries the digest of its
step as a parameter. Starting at the step's file, imports are followed through this project's packages, wherever in a file
they stand; each file is parsed, docstrings are dropped, and the rest is written back in one normal form, so that comments,
docstrings and formatting do not count.

Left out on purpose: the harness (`workflow/step.py`), every `config.py` and `avatar/settings.py`. What a config says reaches the
rule as a parameter of its own, with defaults filled in.

Not seen: imports by a name computed at run time (name those modules in `extra`), data files, and installed packages.

    python -m workflow.digest avatar.train avatar.features.ours_d

prints the digest and the files that it covers, for whoever asks why a step runs again.
"""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("avatar", "fitting", "workflow")
EXCLUDED = frozenset({"workflow.step", "avatar.settings"})


def code_digest(module: str, extra: tuple[str, ...] = (), root: Path = ROOT) -> str:
    """Digest of all code that a module imports, itself included: 16 hex digits.

    Args:
        module: dotted name, such as `avatar.train`.
        extra: modules that it imports by a name chosen at run time, such as `avatar.features.ours_d`.
        root: folder that holds the packages.

    Raises:
        FileNotFoundError: there is no such module.
    """
    digest = hashlib.sha256()
    for name, path in closure(module, extra, root).items():
        digest.update(f"{name}\n{normal_form(path)}\n".encode())
    return digest.hexdigest()[:16]


def closure(module: str, extra: tuple[str, ...] = (), root: Path = ROOT) -> dict[str, Path]:
    """Files of this project that importing the modules runs, by dotted name, sorted; raises as `code_digest`."""
    found: dict[str, Path] = {}
    waiting = [module, *extra]
    for name in waiting:
        if _file_of(name, root) is None:
            raise FileNotFoundError(f"no module {name} under {root}")
    while waiting:
        name = waiting.pop()
        path = _file_of(name, root)
        if name in found or name in EXCLUDED or name.endswith(".config") or path is None:
            continue
        found[name] = path
        waiting.extend(_imported(name, path))
        if "." in name:
            waiting.append(name.rpartition(".")[0])
    return dict(sorted(found.items()))


def normal_form(path: Path) -> str:
    """Source of a file without comments, docstrings and formatting."""
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.body = [statement for statement in body if not _is_bare_string(statement)] or [ast.Pass()]
    return ast.unparse(tree)


def _is_bare_string(node: ast.stmt) -> bool:
    """A docstring, of a module, class, function or attribute: a string that nothing uses."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _file_of(name: str, root: Path) -> Path | None:
    """`avatar.train` -> root/avatar/train.py; a package -> its __init__.py; None for what is not this project's."""
    if name.split(".")[0] not in PACKAGES:
        return None
    stem = root.joinpath(*name.split("."))
    for path in (stem.with_name(stem.name + ".py"), stem / "__init__.py"):
        if path.is_file():
            return path
    return None


def _imported(name: str, path: Path) -> Iterator[str]:
    """Dotted names that a file imports; for `from a import b` both `a` and `a.b`, of which the second may be no module."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), filename=str(path))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")
            parts = parents[: len(parents) - node.level + 1] if node.level else []
            base = ".".join([*parts, node.module] if node.module else parts)
            yield base
            for alias in node.names:
                yield f"{base}.{alias.name}"


def main() -> None:
    """Print the digest of a step and the files that it covers."""
    module, *extra = sys.argv[1:] or ["avatar.train"]
    print(code_digest(module, tuple(extra)))
    for path in closure(module, tuple(extra)).values():
        print(" ", path.relative_to(ROOT))


if __name__ == "__main__":
    main()
