"""What the Snakefile knows before any step runs: the config, checked, and the videos, found. One sentence for each mistake."""

from __future__ import annotations

import difflib
import hashlib
import re
import types
import typing
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

VIDEO_SUFFIXES = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".webm", ".wmv")
RESERVED_SUBJECTS = frozenset(
    {"ablation", "available", "identity", "index", "plots", "published", "speed_error", "tables", "tracking_benchmark"}
)
"""Names under `results/` that belong to all subjects together."""
RESERVED_VARIANTS = frozenset(
    {"export", "fit", "frames", "landmarks", "matte", "page", "plots", "probe", "trim"}
    | {"animate", "drive", "metrics", "render"}
)
"""Names under `results/{subject}/` that belong to all variants together, and folders of a variant by which a path is understood
(`avatar.report.results`, `avatar.report.uses_page`)."""
PREDICTORS = ("mean_frame", "nearest_frame")
"""Trivial predictors that stand beside the avatars in every table."""

Model = TypeVar("Model", bound=BaseModel)


class SettingsError(Exception):
    """A mistake in the config or in the folder of videos: one sentence that says what was found and what to do."""


def validated(model: type[Model], raw: Mapping[str, Any], origin: str, prefix: str = "") -> Model:
    """The raw mapping as a typed config.

    Args:
        model: the pydantic model.
        raw: what YAML held.
        origin: where it stands, for the message: a file's name.
        prefix: path of `raw` inside the file, ending in a dot.

    Raises:
        SettingsError: an unknown key (with the nearest known one), or a value that is not allowed.
    """
    try:
        return model.model_validate(dict(raw or {}))
    except ValidationError as error:
        sentences = [_sentence(model, entry, prefix) for entry in error.errors()]
        raise SettingsError(f"{origin}: {'; '.join(sentences)}") from None


def _sentence(model: type[BaseModel], entry: Any, prefix: str) -> str:
    """`extract.sise is not a key; did you mean extract.size?`"""
    *parents, last = [str(part) for part in entry["loc"]] or [""]
    path = prefix + ".".join([*parents, last])
    if entry["type"] != "extra_forbidden":
        return f"{path} is {entry['input']}, but {_lower(entry['msg'])}"
    keys = _keys_at(model, parents)
    near = difflib.get_close_matches(last, keys, n=1, cutoff=0.5)
    hint = f"did you mean {prefix}{'.'.join([*parents, near[0]])}?" if near else f"the keys there are {', '.join(sorted(keys))}"
    return f"{path} is not a key; {hint}" if keys else f"{path} is not a key; nothing can be set there"


def _lower(message: str) -> str:
    return message[:1].lower() + message[1:]


def _keys_at(model: Any, parents: Iterable[str]) -> list[str]:
    """Field names of the model that stands at a path below another model."""
    for parent in parents:
        if isinstance(model, type) and issubclass(model, BaseModel):
            field = model.model_fields.get(parent)
            model = field.annotation if field else None
        else:  # dict[str, Model]: any name leads to the value's model
            model = (typing.get_args(model) or (None,))[-1]
        if typing.get_origin(model) in (typing.Union, types.UnionType):
            model = next((option for option in typing.get_args(model) if hasattr(option, "model_fields")), None)
    return list(model.model_fields) if isinstance(model, type) and issubclass(model, BaseModel) else []


def read_preset(name: str, folder: Path, models: Mapping[str, type[BaseModel]]) -> dict[str, Any]:
    """A preset as raw mappings by step name, each checked against its model.

    Raises:
        SettingsError: no such preset, YAML that cannot be read, a step or key that a preset may not hold.
    """
    path = folder / f"{name}.yaml"
    names = sorted(file.stem for file in folder.glob("*.yaml"))
    if name not in names:
        raise SettingsError(f"{path.parent}: there is no preset {name!r}; the presets are {', '.join(names)}")
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except yaml.YAMLError as error:
        raise SettingsError(f"{path}: not readable as YAML ({' '.join(str(error).split())})") from None
    for key, value in raw.items():
        if key not in models:
            raise SettingsError(f"{path}: {key} is not a key; a preset holds {' and '.join(models)} only")
        validated(models[key], value, str(path), f"{key}.")
    return raw


def merged(base: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `overrides` laid over it, mapping by mapping."""
    result = dict(base)
    for key, value in overrides.items():
        both = isinstance(value, Mapping) and isinstance(result.get(key), Mapping)
        result[key] = merged(result[key], value) if both else value
    return result


def resolve_variants(
    variants: Mapping[str, Any], folder: Path, models: Mapping[str, type[BaseModel]], origin: str
) -> dict[str, dict[str, BaseModel]]:
    """Complete train and render config of every variant: its preset with its overrides laid over it.

    Args:
        variants: variant name -> model with `preset` and one mapping of overrides per key of `models`.
        folder: folder of presets.
        models: step name -> its model.
        origin: the config's name, for messages.

    Raises:
        SettingsError: no variant, a name that cannot be a folder's or is taken, or a key or value that is not allowed.
    """
    if not variants:
        raise SettingsError(f"{origin}: variants is empty; name at least one, for example variants: {{demo: {{preset: demo}}}}")
    resolved = {}
    for name, variant in variants.items():
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise SettingsError(f"{origin}: variants.{name}: use letters, digits, _ and - only, for it becomes a folder's name")
        if name in RESERVED_VARIANTS or name in PREDICTORS:
            raise SettingsError(f"{origin}: variants.{name}: this name is taken by the pipeline itself; choose another")
        preset = read_preset(variant.preset, folder, models)
        resolved[name] = {
            key: validated(model, merged(preset.get(key) or {}, getattr(variant, key)), origin, f"variants.{name}.{key}.")
            for key, model in models.items()
        }
    return resolved


def check_names(names: Iterable[str], known: Iterable[str], key: str, origin: str) -> None:
    """Raise SettingsError for a name below `key` that is not known."""
    known = sorted(known)
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"the names there are {', '.join(known)}"
            raise SettingsError(f"{origin}: {key}.{name} is not known; {hint}")


def check_drivers(drivers: Mapping[str, Any], subjects: Iterable[str], origin: str) -> None:
    """Raise SettingsError for a driver whose name cannot be a folder's, whose subject has no video, or whose file is not there.

    drivers: name -> model with `video` and `subject`.
    """
    subjects = sorted(subjects)
    for name, driver in drivers.items():
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise SettingsError(f"{origin}: drivers.{name}: use letters, digits, _ and - only, for it becomes a folder's name")
        if driver.subject not in subjects:
            near = difflib.get_close_matches(driver.subject, subjects, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"the subjects are {', '.join(subjects)}"
            raise SettingsError(f"{origin}: drivers.{name}.subject: there is no subject {driver.subject}; {hint}")
        if not Path(driver.video).expanduser().is_file():
            raise SettingsError(f"{origin}: drivers.{name}.video: there is no file {driver.video}")


def discover(folder: Path) -> dict[str, Path]:
    """The videos of a folder by subject name; other files, hidden files and folders are left alone.

    Raises:
        SettingsError: no folder, no video, two videos for one name, or a name that cannot be used.
    """
    how = "put one video a subject there, or name another folder: snakemake --config videos=FOLDER"
    if not folder.is_dir():
        raise SettingsError(f"{folder}: there is no such folder; {how}")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.suffix.lower() not in VIDEO_SUFFIXES or not path.is_file():
            continue
        name = subject_name(path.stem)
        if not name or name in RESERVED_SUBJECTS or "{" in str(path) or "}" in str(path):
            raise SettingsError(f"{path}: this name cannot be used for a subject; rename the file")
        if name in found:
            raise SettingsError(f"{found[name]} and {path} would both be the subject {name}; rename or remove one of them")
        found[name] = path
    if not found:
        raise SettingsError(f"{folder}: there is no video in this folder ({' '.join(VIDEO_SUFFIXES)}); {how}")
    return found


def subject_name(stem: str) -> str:
    """A file's stem as a folder's name: letters of any script, digits, `_` and `-` stay; runs of anything else become `_`.

    No name begins with `-`: on a command line it would be an option.
    """
    return re.sub(r"[^\w-]+", "_", unicodedata.normalize("NFC", stem)).lstrip("-_").rstrip("_")


def fingerprint(path: Path, sample_bytes: int = 1 << 20) -> str:
    """Size and hash of a file's first and last MiB: tells another video from a copied or touched one without reading it all."""
    size = path.stat().st_size
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        digest.update(file.read(sample_bytes))
        file.seek(max(0, size - sample_bytes))
        digest.update(file.read(sample_bytes))
    return f"{size}-{digest.hexdigest()[:16]}"
