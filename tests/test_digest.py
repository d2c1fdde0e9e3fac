"""The code digest: what counts as a change of a step's code, and which files it covers."""

from __future__ import annotations

from pathlib import Path

import pytest

from workflow import digest

FILES = {
    "workflow/__init__.py": "",
    "workflow/step.py": "def main(): return 1\n",
    "fitting/__init__.py": "",
    "fitting/config.py": "SIZE = 1\n",
    "fitting/camera.py": 'def project(x):\n    """Pixels."""\n    return x * 2  # why\n',
    "fitting/energy.py": "from fitting.camera import project\n",
    "fitting/fit.py": "import numpy\nfrom fitting import energy\nfrom fitting.config import SIZE\nfrom workflow import step\n",
    "fitting/matte.py": "from workflow import step\n",
    "avatar/__init__.py": "",
    "avatar/build.py": "import importlib\ndef build(name):\n    return importlib.import_module('avatar.features.' + name)\n",
    "avatar/train.py": "def run():\n    from .build import build\n    return build('ours_d')\n",
    "avatar/features/__init__.py": "",
    "avatar/features/ours_d.py": "from ..networks import conv\n",
    "avatar/features/ours_c.py": "x = 1\n",
    "avatar/networks.py": "import fitting.camera\nconv = 1\n",
}


@pytest.fixture
def code(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def write(root: Path, name: str, text: str) -> None:
    (root / name).write_text(text)


def test_closure_follows_imports_and_leaves_out_harness_and_config(code: Path) -> None:
    assert list(digest.closure("fitting.fit", root=code)) == [
        "fitting", "fitting.camera", "fitting.energy", "fitting.fit", "workflow",
    ]  # fmt: skip


def test_closure_sees_relative_imports_inside_functions(code: Path) -> None:
    assert "avatar.build" in digest.closure("avatar.train", root=code)


def test_extra_module_brings_what_it_imports(code: Path) -> None:
    plain = digest.closure("avatar.train", root=code)
    whole = digest.closure("avatar.train", ("avatar.features.ours_d",), root=code)
    assert set(whole) - set(plain) == {
        "avatar.features", "avatar.features.ours_d", "avatar.networks", "fitting", "fitting.camera",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("fitting/camera.py", '"""New."""\ndef project(x):\n    """Other words."""\n    # a comment\n    return (x *\n  2)\n'),
        ("fitting/camera.py", 'def project(x):\n    return x * 2\n\n\n"""A string that nothing uses."""\n'),
        ("workflow/step.py", "def main(): return 2\n"),
        ("fitting/config.py", "SIZE = 2\n"),
        ("fitting/matte.py", "x = 1\n"),
        ("avatar/train.py", "x = 1\n"),
    ],
)
def test_what_changes_nothing(code: Path, name: str, text: str) -> None:
    before = digest.code_digest("fitting.fit", root=code)
    write(code, name, text)
    assert digest.code_digest("fitting.fit", root=code) == before


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("fitting/camera.py", "def project(x):\n    return x * 3\n"),
        ("fitting/camera.py", "def project(x: int):\n    return x * 2\n"),
        ("fitting/energy.py", "from fitting.camera import project\nprint('a string that is used')\n"),
        ("fitting/__init__.py", "import os\n"),
        ("fitting/fit.py", "from fitting import energy, matte\nfrom workflow import step\n"),
    ],
)
def test_what_changes_the_digest(code: Path, name: str, text: str) -> None:
    before = digest.code_digest("fitting.fit", root=code)
    write(code, name, text)
    assert digest.code_digest("fitting.fit", root=code) != before


def test_function_whose_body_is_a_docstring(code: Path) -> None:
    write(code, "fitting/camera.py", 'class Error(Exception):\n    """Words."""\n')
    before = digest.code_digest("fitting.fit", root=code)
    write(code, "fitting/camera.py", "class Error(Exception):\n    pass\n")
    assert digest.code_digest("fitting.fit", root=code) == before


def test_moving_code_between_files_counts(code: Path) -> None:
    """The same text under another name is another module."""
    before = digest.code_digest("fitting.fit", root=code)
    (code / "fitting/camera.py").rename(code / "fitting/lens.py")
    write(code, "fitting/energy.py", "from fitting.lens import project\n")
    assert digest.code_digest("fitting.fit", root=code) != before


def test_another_representation_does_not_count(code: Path) -> None:
    before = digest.code_digest("avatar.train", ("avatar.features.ours_d",), root=code)
    write(code, "avatar/features/ours_c.py", "x = 2\n")
    assert digest.code_digest("avatar.train", ("avatar.features.ours_d",), root=code) == before
    write(code, "avatar/networks.py", "conv = 2\n")
    assert digest.code_digest("avatar.train", ("avatar.features.ours_d",), root=code) != before


def test_place_of_the_checkout_does_not_count(code: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    other = tmp_path_factory.mktemp("elsewhere")
    for name, text in FILES.items():
        (other / name).parent.mkdir(parents=True, exist_ok=True)
        write(other, name, text)
    assert digest.code_digest("fitting.fit", root=other) == digest.code_digest("fitting.fit", root=code)


def test_no_such_module(code: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no module fitting\.fitt"):
        digest.code_digest("fitting.fitt", root=code)


STEPS = ("fetch", "head", "probe", "extract", "matte", "detect", "split", "fit", "trim", "export", "simulate", "benchmark")


@pytest.mark.parametrize("step", [f"fitting.{name}" for name in STEPS])
def test_preparation_knows_nothing_of_avatars(step: str) -> None:
    assert not [name for name in digest.closure(step) if name.startswith("avatar")]


def test_training_does_not_import_metrics() -> None:
    covered = digest.closure("avatar.train", ("avatar.features.ours_d",))
    assert "avatar.metrics" not in covered
    assert "avatar.evaluate" not in covered


def test_workflow_package_looks_at_nothing_above_it() -> None:
    """Imports point one way: avatar -> fitting -> workflow."""
    for path in (digest.ROOT / "workflow").glob("*.py"):
        assert not [name for name in digest.closure(f"workflow.{path.stem}") if not name.startswith("workflow")], path
