"""The page over all subjects, and the page of an avatar's uses: every subject a card, every row its figures or its reason."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from snakemake.common import get_report_id
from snakemake.iocontainers import FILE_HASH_PREFIX_LEN

from avatar.report import index_page, pictures, uses_page
from avatar.report.config import IndexConfig, UsesConfig
from fitting.video import write_video
from workflow import step


def scored(subject: str, variant: str, lpips: float, **more: object) -> dict:
    row = {"subject": subject, "variant": variant, "status": "ok", "predictor": False, "published": False, "note": ""}
    return row | {"lpips_mean": lpips, "ssim_mean": 0.9, "psnr_mean": 25.0, "ms_per_frame": 9.0, "scored_frames": 8} | more


ROWS = [
    scored("ann", "fast", 0.123, lpips_mouth_mean=0.2),
    scored("ann", "slow", 0.101, lpips_mouth_mean=0.3),
    scored("ann", "nearest_frame", 0.05, predictor=True, note="trivial predictor: not trained"),
    scored("ann", "theirs", 0.01, published=True),
    scored("cem", "fast", 0.2),
    {"subject": "cem", "variant": "slow", "status": "failed", "note": "failed: logs/cem/slow/train.log ends <here>"},
    {"subject": "bob", "variant": "", "status": "rejected", "note": "no face in 62 % of the frames"},
    {"subject": "dan", "variant": "", "status": "failed", "note": "failed: see logs/dan/"},
]


def build(folder: Path, rows: list[dict], pages: tuple[str, ...] = ("ann", "cem")) -> str:
    """Run the step; the page's text."""
    folder.mkdir(exist_ok=True)
    pd.DataFrame(rows).to_csv(folder / "metrics.csv", index=False)
    (folder / "speed.svg").write_text("<svg/>")
    inputs = [f"table={folder / 'metrics.csv'}", f"plots={folder / 'speed.svg'}"]
    for name in pages:
        (folder / name / "page").mkdir(parents=True)
        (folder / name / "page" / "card.jpg").write_bytes(pictures.jpeg(np.full((40, 80, 3), 90, np.uint8)))
        inputs.append(f"pages={folder / name / 'page'}")
    step.main(index_page.run, IndexConfig, ["--subject", "all", "--input", *inputs, "--output", f"page={folder / 'index'}"])
    return (folder / "index" / "index.html").read_text()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("results")
    return folder, build(folder, ROWS)


def test_cards_say_what_became_of_each_subject(site: tuple[Path, str]) -> None:
    cards = re.findall(r"<li>(.*?)</li>", site[1].partition("<section")[0], re.S)
    ann, cem, bob, dan = cards
    assert "best avatar: slow" in ann and "<strong>0.101</strong>" in ann and "card_000.jpg" in ann and "tag bad" not in ann
    assert (
        "best avatar: fast" in cem
        and "slow: failed: logs/cem/slow/train.log ends &lt;here&gt;" in cem
        and "failed: failed" not in site[1]
    )
    assert "rejected" in bob and "no face in 62 %" in bob and "<img" not in bob and "<a" not in bob
    assert "see logs/dan/" in dan and "tag bad" in dan
    assert "4 subjects: 2 with scores, 1 rejected, 1 failed" in site[1]


def test_every_row_has_figures_or_a_reason(site: tuple[Path, str]) -> None:
    rows = re.findall(r"<tr>(.*?)</tr>", site[1].partition("<tbody>")[2], re.S)
    assert len(rows) == len(ROWS)
    assert not re.search(r"<td[^>]*>\s*(<span[^>]*>\s*</span>)?\s*</td>", "".join(rows))
    for row, truth in zip(rows, ROWS, strict=True):
        assert truth["status"] == "ok" or 'class="reason"' in row
    assert rows[3].count('class="best"') >= 1 and "published" in rows[3] and '<span class="best">0.200</span>' in rows[0]
    assert 'class="best"' not in rows[4]
    assert "trivial predictor: not trained (ann/nearest_frame)" in site[1]


def test_links_lead_to_the_pages_from_disk_and_where_snakemake_puts_them(site: tuple[Path, str]) -> None:
    folder, text = site
    assert set(re.findall(r'href="(\.\.[^"]*)"', text)) == {"../ann/page/index.html", "../cem/page/index.html"}
    places = {get_report_id(folder / name / "page" / "index.html")[:FILE_HASH_PREFIX_LEN] for name in ("ann", "cem")}
    assert set(re.findall(r'data-report="\.\./(\w+)/index.html"', text)) == places
    files = {path.name for path in (folder / "index").iterdir()}
    assert files == {"index.html", "card_000.jpg", "card_001.jpg", "metrics.csv", "speed.svg"}


def test_only_rejected_subjects_still_make_a_page(tmp_path: Path) -> None:
    text = build(tmp_path / "r", ROWS[6:7], ())
    assert "1 subject: 1 rejected" in text and text.count("no face in 62 %") == 2


@pytest.mark.parametrize(("content", "sentence"), [("", "not readable"), ("subject,status\n", "column variant is missing"),
                                                   ("subject,variant,status,note\n", "there is no subject")])  # fmt: skip
def test_a_damaged_table_is_one_sentence(tmp_path: Path, caplog: pytest.LogCaptureFixture, content: str, sentence: str) -> None:
    (tmp_path / "metrics.csv").write_text(content)
    with pytest.raises(SystemExit) as stopped:
        arguments = ["--input", f"table={tmp_path / 'metrics.csv'}", "--output", f"page={tmp_path / 'index'}"]
        step.main(index_page.run, IndexConfig, arguments)
    assert stopped.value.code == 1 and sentence in caplog.text and not (tmp_path / "index").exists()


def test_uses_stand_in_order_each_with_its_files(tmp_path: Path) -> None:
    home = tmp_path / "ann" / "fast"
    videos, reports = [], []
    for use in ("orbit", "drive/bob", "drive/ann2", "zoom"):
        (home / use).mkdir(parents=True)
        video = home / use / "result.mp4"
        write_video(
            video, [np.full((32, 32, 3), level, np.uint8) for level in range(4)], 4.0, comment="Synthetic: avatar sha256:ab"
        )
        report = home / use / "result.json"
        report.write_text(json.dumps({"driver": "clip <1>", "frames": list(range(9)), "provenance": {}}))
        videos.append(f"videos={video}")
        reports.append(f"reports={report}")
    picture = home / "orbit" / "sheet.png"
    picture.write_bytes(pictures.png(np.zeros((8, 8, 3), np.uint8)))
    inputs = ["--subject", "ann", "--input", *videos, *reports, f"pictures={picture}", "--output", f"page={home / 'uses'}"]
    step.main(uses_page.run, UsesConfig, inputs)
    text = (home / "uses" / "index.html").read_text()
    assert re.findall(r"<h2>(.*?)</h2>", text) == ["drive: ann2", "drive: bob", "orbit", "zoom"]
    assert text.count("Synthetic: avatar sha256:ab") == 4 and "clip &lt;1&gt;" in text and "9 entries" in text
    assert "ann: uses of fast" in text and "rendered by a trained avatar, not filmed" in text
    named = set(re.findall(r'src="([^"]+)"', text))
    assert named == {path.name for path in (home / "uses").iterdir()} - {"index.html"} and len(named) == 5


def test_no_use_is_one_sentence(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SystemExit):
        step.main(uses_page.run, UsesConfig, ["--subject", "ann", "--output", f"page={tmp_path / 'uses'}"])
    assert "no use to show" in caplog.text
