"""What the pages are put together from: a report's values in words, and the folder while it is made."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from avatar.report import pictures
from avatar.report.page_style import STYLE


def words(name: str) -> str:
    """`reprojection_percent` -> `reprojection percent`."""
    return name.replace("_", " ")


def shown(value: Any) -> str:
    """A JSON value in a few words: long lists become their length."""
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else str(value)
    if isinstance(value, dict):
        return ", ".join(f"{words(str(key))} {shown(item)}" for key, item in value.items())
    if isinstance(value, list):
        if not value:
            return "none"
        return ", ".join(shown(item) for item in value) if len(value) <= 6 else f"{len(value)} entries"
    return str(value)


def facts(content: dict[str, Any], without: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    """Names and values of a JSON report, without its provenance."""
    return [(words(key), shown(value)) for key, value in content.items() if key not in ("provenance", *without)]


class Folder:
    """A page's folder while it is made."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True)

    def picture(self, name: str, image: np.ndarray, alt: str, caption: str) -> dict[str, Any]:
        """Write a picture uint8 [H, W, 3] as PNG; what the template needs to show it."""
        (self.path / name).write_bytes(pictures.png(image))
        return {"file": name, "alt": alt, "caption": caption, "width": image.shape[1], "height": image.shape[0]}

    def copy(self, source: Path, name: str) -> str:
        """Copy a file and return its name."""
        shutil.copyfile(source, self.path / name)
        return name

    def write(self, template: str, content: dict[str, Any]) -> str:
        """Render the template into index.html; a value that the template misses is an error. What the log says of it."""
        environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
        text = environment.from_string(template).render({"style": STYLE} | content)
        (self.path / "index.html").write_text(text, encoding="utf-8")
        sizes = [path.stat().st_size for path in self.path.iterdir()]
        return f"page of {len(sizes)} files, {sum(sizes) / 1e6:.1f} MB"
