"""The pages in a real browser: what the player shows is read back from pictures of the screen, frame by frame.

Each made frame carries its number as black and white blocks, so that a picture of a tile says which frame it is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import browser as chromium
import numpy as np
import pandas as pd
import pytest
from snakemake.common import get_report_id
from snakemake.iocontainers import FILE_HASH_PREFIX_LEN

from avatar.report import index_page, page, uses_page
from avatar.report.config import IndexConfig, PageConfig, UsesConfig
from fitting.video import write_video
from workflow import step

pytestmark = pytest.mark.skipif(
    chromium.program() is None, reason=f"no browser on this machine (looked for {', '.join(chromium.NAMES)})"
)
BITS, BLOCK, COUNT, FIRST, FPS = 6, 24, 40, 20, 24.0
GREYS = {"input": 128, "fast": 60, "slow": 190, "mean_frame": 230}
"""Lower half of each tile: tells one panel from another."""
LATE_S = 10
SETTLED = "document.querySelector('.player').dataset.place === '{0}' && !document.querySelector('video').seeking"


def coded(number: int, grey: int) -> np.ndarray:
    """uint8 [72, 144, 3]: a frame's number as blocks above, a grey below."""
    image = np.full((3 * BLOCK, BITS * BLOCK, 3), grey, np.uint8)
    for bit in range(BITS):
        image[:BLOCK, bit * BLOCK : (bit + 1) * BLOCK] = 255 * (number >> bit & 1)
    return image


def decoded(image: np.ndarray) -> tuple[int, int]:
    """Number and grey of a picture of a tile of any size; a block that is neither black nor white fails."""
    height, width = image.shape[:2]
    blocks = [float(image[height // 6, int((bit + 0.5) * width / BITS)].mean()) for bit in range(BITS)]
    assert all(level < 60 or level > 195 for level in blocks), blocks
    return sum((level > 128) << bit for bit, level in enumerate(blocks)), int(image[2 * height // 3, width // 2].mean())


def arguments(inputs: dict[str, Path | list[Path]], page: Path, subject: str = "ann") -> list[str]:
    """The command line that a rule would give a step."""
    named = [f"{name}={path}" for name, value in inputs.items() for path in (value if isinstance(value, list) else [value])]
    return ["--subject", subject, "--input", *named, "--output", f"page={page}"]


def write(path: Path, content: dict) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """results/ann/page, results/index and results/ann/fast/uses, made by the steps."""
    root = tmp_path_factory.mktemp("site") / "results"
    ann = root / "ann"
    ann.mkdir(parents=True)
    frames = list(range(FIRST, FIRST + COUNT))
    numbers = [max(0, frame - FIRST) for frame in range(FIRST + COUNT)]
    np.save(ann / "frames.npy", np.stack([coded(number, GREYS["input"]) for number in numbers]))
    np.save(ann / "alpha.npy", np.full((len(numbers), 3 * BLOCK, BITS * BLOCK), 255, np.uint8))
    write(ann / "frames.json", {"fps": FPS, "time_s": [frame / FPS for frame in range(len(numbers))]})
    write(ann / "probe.json", {"accepted": True, "file": "ann.mp4", "warnings": ["a word-of-no-end-" + "x" * 120]})
    write(ann / "fit.json", {"decisions": {"neck": "fixed"}, "not_determined": ["the back of the head"]})
    lists: dict[str, list[Path]] = {}
    for variant, grey in list(GREYS.items())[1:]:
        folder = ann / variant
        images = np.stack([coded(number, grey) for number in range(COUNT)])
        write(folder / "render" / "render.json", {"frames": frames, "ms_per_frame": 5.0})
        np.save(folder / "render" / "test.npy", np.concatenate([images, np.full_like(images[..., :1], 255)], -1))
        write_video(folder / "render" / "test.mp4", images[:2], FPS, comment=f"Synthetic: {variant}; avatar sha256:{'ab' * 32}")
        error = 0.1 + 0.002 * grey / 60 * np.arange(COUNT)
        regions = {f"lpips_{region}": error for region in ("face", "mouth", "eyes")}
        table = pd.DataFrame({"frame": frames, "lpips": error, "psnr": 30 - error, "ssim": 1 - error, "l1": error} | regions)
        (folder / "metrics").mkdir()
        table.drop(index=5).to_csv(folder / "metrics" / "per_frame.csv", index=False)
        means = {name: {"mean": float(table[name].mean()), "std": 0.01, "n": COUNT - 1} for name in table if name != "frame"}
        scores = {"predictor": variant == "mean_frame", "metrics": means, "test_frames": COUNT, "scored_frames": COUNT - 1}
        scores |= {"excluded": {"count": 1, "reason": "the fit could not track them"}, "ms_per_frame": 5.0}
        write(folder / "metrics" / "metrics.json", scores | {"protocol": {"resolution": "144x72", "background": "white"}})
        for name, file in {"renders": "render/test.npy", "reports": "render/render.json", "videos": "render/test.mp4",
                           "metrics": "metrics/metrics.json", "per_frames": "metrics/per_frame.csv"}.items():  # fmt: skip
            lists.setdefault(name, []).append(folder / file)
    single = {"probe": "probe.json", "fit": "fit.json", "frames": "frames.npy", "index": "frames.json", "alpha": "alpha.npy"}
    inputs = {name: ann / file for name, file in single.items()} | {"overlay": ann / "fast" / "render" / "test.mp4"} | lists
    step.main(page.run, PageConfig, arguments(inputs, ann / "page"))

    rows = [
        {"subject": "ann", "variant": name, "status": "ok", "predictor": name == "mean_frame", "note": ""}
        | {"lpips_mean": 0.2 - place / 20, "ssim_mean": 0.9, "psnr_mean": 25.0 + place}
        for place, name in enumerate(("fast", "slow", "mean_frame"))
    ]
    rows.append({"subject": "bob", "variant": "", "status": "rejected", "note": "no face in 62 % of the frames"})
    pd.DataFrame(rows).to_csv(root / "metrics.csv", index=False)
    listed = {"table": root / "metrics.csv", "pages": ann / "page"}
    step.main(index_page.run, IndexConfig, arguments(listed, root / "index", "all"))

    orbit = ann / "fast" / "orbit"
    report = write(orbit / "orbit.json", {"frames": 9, "view_degrees": 30})
    write_video(orbit / "orbit.mp4", [coded(number, 99) for number in range(9)], FPS, comment="Synthetic: orbit")
    step.main(uses_page.run, UsesConfig, arguments({"videos": orbit / "orbit.mp4", "reports": report}, ann / "fast" / "uses"))
    return root


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[chromium.Browser]:
    found = chromium.Browser(tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


@pytest.fixture
def player(tab: chromium.Browser, results: Path) -> chromium.Browser:
    """The subject's page, at its first frame, with nothing said on the console when the test ends."""
    tab.open(results / "ann" / "page" / "index.html")
    tab.wait(SETTLED.format(0))
    yield tab
    assert not tab.complaints()


def panels_show(tab: chromium.Browser) -> dict[int, tuple[int, int]]:
    """Number and grey of every visible panel, from one picture of the screen."""
    left, top, _, _ = tab.box(".panels")
    boxes = tab.run("[...document.querySelectorAll('.panels figure:not([hidden])')].map(figure => [figure, figure.querySelector("
                    "'canvas').getBoundingClientRect()]).map(([figure, box]) => [+figure.dataset.panel, box.left + scrollX, "
                    "box.top + scrollY, box.width, box.height])")  # fmt: skip
    picture = tab.picture(".panels")
    found = {}
    for panel, x, y, width, height in boxes:
        row, column = round(y - top), round(x - left)
        found[panel] = decoded(picture[row : row + int(height), column : column + int(width)])
    return found


def assert_shown(tab: chromium.Browser, place: int) -> None:
    """Every visible panel shows this frame, and the words name it."""
    tab.wait(SETTLED.format(place))
    end = time.monotonic() + LATE_S
    found = panels_show(tab)
    while {number for number, _ in found.values()} != {place} and time.monotonic() < end:
        found = panels_show(tab)  # a seek may end before its picture is there
    assert {number for number, _ in found.values()} == {place}, found
    names = list(GREYS)
    assert all(abs(grey - GREYS[names[panel]]) < 12 for panel, (_, grey) in found.items()) and len(found) >= 3, found
    assert f"frame {FIRST + place} · {(FIRST + place) / FPS:.2f} s" in tab.run("document.querySelector('.where').textContent")


def test_seeks_are_exact_to_the_frame_in_all_panels(player: chromium.Browser) -> None:
    for place in (0, 1, 12, 39, 25, 24, 11, 38):
        player.run(f"(s => {{ s.value = {place}; s.dispatchEvent(new Event('input')); }})(document.querySelector('.scrub'))")
        assert_shown(player, place)
    # Faster than the browser can seek: the last wish counts.
    player.run("(s => { for (let i = 0; i < 30; i++) { s.value = i; s.dispatchEvent(new Event('input')); } })"
               "(document.querySelector('.scrub'))")  # fmt: skip
    assert_shown(player, 29)


def test_keys_step_and_jump(player: chromium.Browser) -> None:
    player.run("document.querySelector('.player').focus()")
    for key, shift, place in (("ArrowRight", False, 1), ("ArrowRight", True, 11), ("ArrowLeft", False, 10), ("End", False, 39),
                              ("ArrowRight", False, 39), ("ArrowLeft", True, 29), ("Home", False, 0)):  # fmt: skip
        player.press(key, shift)
        player.wait(SETTLED.format(place))
    assert_shown(player, 0)
    player.press("Tab")
    assert player.run("document.activeElement.className") == "scrub"
    assert player.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    assert player.run("document.activeElement.getAttribute('aria-valuetext')") == f"frame {FIRST}, {FIRST / FPS:.2f} s"


def test_it_plays_in_step_and_stops_where_it_says(player: chromium.Browser) -> None:
    player.run("document.querySelector('.player').focus()")
    player.press(" ")
    player.wait("+document.querySelector('.player').dataset.place", lambda place: place >= 4)
    assert player.run("document.querySelector('.play').getAttribute('aria-label')") == "Pause"
    player.press(" ")
    player.wait("document.querySelector('video').paused && !document.querySelector('video').seeking")
    time.sleep(0.2)
    assert_shown(player, player.run("+document.querySelector('.player').dataset.place"))
    assert player.run("document.querySelector('.play').getAttribute('aria-label')") == "Play"
    player.press("End")
    player.wait(SETTLED.format(COUNT - 1))
    player.press(" ")  # from the end it begins again
    player.wait("+document.querySelector('.player').dataset.place", lambda place: 2 <= place < COUNT - 1)
    player.press(" ")


def test_curve_worst_frames_and_boxes(player: chromium.Browser) -> None:
    player.click(".curve", 0.5)
    assert_shown(player, 20)
    assert player.run("document.querySelector(\"[data-panel='1'] .here\").textContent") == "LPIPS 0.140 · PSNR 29.86 dB"
    assert player.run("document.querySelector(\"[data-panel='1'] .best\").textContent") == "LPIPS 0.140"
    player.click(".curve", (8 + (player.box(".curve")[2] - 16) * 5 / 39) / player.box(".curve")[2])
    player.wait(SETTLED.format(5))
    assert player.run("document.querySelector(\"[data-panel='1'] .here\").textContent") == "not scored"
    player.click(".jump")
    assert_shown(player, 39)  # the worst frame is the last
    player.click(".show[value='3']")
    assert_shown(player, 39)
    assert len(panels_show(player)) == 4
    player.click(".differ")
    assert panels_show(player)[1][0] == 0  # the same blocks: no difference above, and below that of the greys
    assert player.picture("[data-panel='2'] canvas")[-20, 20].mean() > 150
    assert player.run("document.querySelectorAll('.curve path').length") == 3
    player.run("(m => { m.value = 'lpips_mouth'; m.dispatchEvent(new Event('change')); })(document.querySelector('.metric'))")
    assert player.run("document.querySelectorAll('.curve path').length") == 3


@pytest.mark.parametrize(("width", "dark"), [(1280, True), (390, False)])
def test_screens(tab: chromium.Browser, results: Path, width: int, dark: bool) -> None:
    for file in ("ann/page", "index", "ann/fast/uses"):
        tab.open(results / file / "index.html", width, 844, dark)
        if file == "ann/page":
            tab.wait(SETTLED.format(0))
        assert tab.run("document.documentElement.scrollWidth") <= width, file
        wide = tab.run("[...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll, svg, pre') && "
                       "e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 120))")  # fmt: skip
        assert not wide, (file, wide)
        picture = tab.picture()
        assert picture.shape == (844, width, 3) and len(np.unique(picture @ [65536, 256, 1])) > 30
        assert bool(picture[2, 2].mean() < 60) is dark
        assert not tab.complaints()


def test_a_finger_moves_the_curve_on_a_narrow_screen(tab: chromium.Browser, results: Path) -> None:
    tab.open(results / "ann" / "page" / "index.html", 390, 844)
    tab.wait(SETTLED.format(0))
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True)
    left, top, width, height = tab.box(".curve")
    point = {"x": left + width - 8 - tab.run("scrollX"), "y": top + height / 2 - tab.run("scrollY")}
    tab.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[point])
    tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert_shown(tab, COUNT - 1)
    assert min(tab.run("[...document.querySelectorAll('.controls button')].map(b => b.getBoundingClientRect().height)")) >= 38
    tab.call("Emulation.setTouchEmulationEnabled", enabled=False)
    assert not tab.complaints()


def test_the_index_sorts_and_leads_on_from_disk_and_inside_a_report(tab: chromium.Browser, results: Path) -> None:
    tab.open(results / "index" / "index.html")
    order = "[...document.querySelectorAll('tbody tr')].map(row => row.cells[1].dataset.value)"
    assert tab.run(order) == ["fast", "slow", "mean_frame", ""]
    tab.click("th:nth-child(3) button")
    assert tab.run(order) == ["mean_frame", "slow", "fast", ""]
    tab.click("th:nth-child(3) button")
    assert tab.run(order) == ["fast", "slow", "mean_frame", ""]
    tab.click(".cards h2 a")
    tab.wait("document.title === 'ann: head avatar' && document.readyState === 'complete'")
    # As Snakemake lays out report.zip.
    raw = results.parent / "report" / "data" / "raw"
    places = {}
    for folder in (results / "ann" / "page", results / "index"):
        places[folder.name] = raw / get_report_id(folder / "index.html")[:FILE_HASH_PREFIX_LEN]
        places[folder.name].parent.mkdir(parents=True, exist_ok=True)
        folder.rename(places[folder.name])
    try:
        tab.open(places["index"] / "index.html")
        tab.click(".cards h2 a")
        tab.wait("document.title === 'ann: head avatar' && document.readyState === 'complete'")
        tab.wait(SETTLED.format(0))
        assert not tab.complaints()
    finally:
        places["page"].rename(results / "ann" / "page")
        places["index"].rename(results / "index")


def test_without_script_there_is_a_video_and_a_table(tab: chromium.Browser, results: Path) -> None:
    tab.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        tab.open(results / "ann" / "page" / "index.html")
        assert tab.box(".player video")[3] > 100 and tab.run("document.querySelector('.player video').controls")
        assert "Without JavaScript" in tab.run("document.body.innerText")
        assert tab.run("getComputedStyle(document.querySelector('.panels')).display") == "none"
        tab.open(results / "index" / "index.html")
        assert tab.run("document.querySelectorAll('tbody tr').length") == 4
    finally:
        tab.call("Emulation.setScriptExecutionDisabled", value=False)


def test_videos_of_uses_load(tab: chromium.Browser, results: Path) -> None:
    tab.open(results / "ann" / "fast" / "uses" / "index.html")
    tab.wait("[...document.querySelectorAll('video')].every(video => video.readyState >= 2)")
    assert tab.run("document.querySelector('video').duration") == pytest.approx(9 / FPS, abs=0.01)
    text = tab.run("document.body.innerText")
    assert "Synthetic: orbit" in text and "orbit/orbit.mp4" in text and "view degrees" in text
    assert not tab.complaints()
