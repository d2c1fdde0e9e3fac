"""What is generated from the typed config is current, and the shipped config and presets are valid."""

from __future__ import annotations

import json

import jsonschema
import pytest
import yaml

from avatar import document
from avatar.config import RenderConfig, TrainConfig
from avatar.settings import Settings
from workflow import environment, settings

PRESETS = sorted((document.ROOT / "config" / "presets").glob("*.yaml"))
CONFIG = yaml.safe_load((document.ROOT / "config" / "config.yaml").read_text(encoding="utf-8"))


def test_readme_and_schema_are_current() -> None:
    how = "run: python -m avatar.document"
    assert document.README.read_text(encoding="utf-8") == document.readme(), how
    assert document.SCHEMA.read_text(encoding="utf-8") == document.schema(), how


def test_every_key_is_explained() -> None:
    """One sentence a field: no field without a description."""
    for model in (Settings, TrainConfig, RenderConfig):
        for path, field in document._flat(model, ""):
            assert field.description, f"{model.__name__}.{path}"


def test_shipped_config_passes_the_schema() -> None:
    jsonschema.validate(CONFIG, json.loads(document.schema()))
    settings.validated(Settings, CONFIG, "config.yaml")


def test_schema_refuses_a_misspelt_override() -> None:
    with pytest.raises(jsonschema.ValidationError, match="stps"):
        jsonschema.validate({"variants": {"demo": {"train": {"stps": 3}}}}, json.loads(document.schema()))


@pytest.mark.parametrize("preset", [path.stem for path in PRESETS])
def test_shipped_presets_are_valid(preset: str) -> None:
    models = {"train": TrainConfig, "render": RenderConfig}
    raw = settings.read_preset(preset, document.ROOT / "config" / "presets", models)
    assert set(raw) <= set(models)


def test_overrides_are_laid_over_the_preset_key_by_key() -> None:
    assert settings.merged({"a": 1, "b": {"c": 2, "d": 3}}, {"b": {"c": 4}}) == {"a": 1, "b": {"c": 4, "d": 3}}


def test_opencv_is_the_headless_contrib_build_alone() -> None:
    assert environment.problem() is None


def pins_of(name: str) -> list[str]:
    lines = (document.ROOT / name).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith(("#", "./"))]


def test_requirements_pin_everything_exactly() -> None:
    pins = pins_of("requirements.txt")
    assert all(line.count("==") == 1 and "+" not in line for line in [*pins, *pins_of("requirements-test.txt")])
    assert "torch==2.13.0" in pins
    assert not [line for line in pins if line.startswith(("torchvision", "opencv-contrib-python=", "opencv-python"))]


def test_users_do_not_install_what_only_tests_need() -> None:
    """smplx is under a licence for non-commercial research: no step imports it, and it comes with `make test` alone."""
    assert [line.partition("==")[0] for line in pins_of("requirements-test.txt")] == ["smplx"]
    assert not [line for line in pins_of("requirements.txt") if line.startswith("smplx")]
    for package in ("avatar", "fitting", "workflow"):
        for path in (document.ROOT / package).rglob("*.py"):
            assert "import smplx" not in path.read_text(encoding="utf-8"), path
