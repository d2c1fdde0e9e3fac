"""play: the page in a real browser. The picture that a slider asked for is read back from the screen; so is a made webcam's."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import browser as chromium
import numpy as np
import pytest

from avatar.play.server import Server
from fitting.detection import Face
from tests.made_driver import face_of
from tests.made_play import FRAMES, MadeFinder, clip, html, session
from tests.small_face import true_head

pytestmark = pytest.mark.skipif(
    chromium.program() is None, reason=f"no browser on this machine (looked for {', '.join(chromium.NAMES)})"
)
CAMERA = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
DRAWN = "+document.getElementById('picture').dataset.number"
VERSION = "+document.getElementById('picture').dataset.version"


def face(_: int) -> Face:
    return face_of(true_head(), {"jawOpen": 0.7})


@pytest.fixture(scope="module")
def served() -> Iterator[Server]:
    """A server whose made detector finds a face with an open jaw in every picture that is not black."""

    def offer(name: str, data: bytes) -> dict:
        if b"jawOpen" not in data:
            raise ValueError(f"{name}: the column x is not known")
        server.session.offer("file", clip())
        return {"frames": FRAMES}

    with session(MadeFinder(face)) as running:
        server = Server(running, html(running), offer)
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        yield server
        server.shutdown()
        server.server_close()


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[chromium.Browser]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chromium, "FLAGS", (*chromium.FLAGS, *CAMERA))
        browser = chromium.Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def visit(tab: chromium.Browser, address: str, width: int = 1280, height: int = 860, dark: bool = False) -> None:
    """Load the page in a window of this size and wait for its first picture."""
    tab.call("Page.navigate", url="about:blank")
    tab.wait("location.href === 'about:blank'")
    tab.events.clear()
    tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
    tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}])
    tab.call("Page.navigate", url=address)
    tab.wait(f"document.readyState === 'complete' && location.href !== 'about:blank' && {DRAWN} > 0")


@pytest.fixture
def page(tab: chromium.Browser, served: Server) -> chromium.Browser:
    visit(tab, served.address)
    tab.click("#reset")
    tab.run("document.querySelector('[name=source][value=sliders]').click()")
    tab.wait("state.source === 'sliders'")
    return tab


def jaw(tab: chromium.Browser) -> float:
    """How far the jaw is open in the picture on the screen."""
    image = tab.picture("#picture")
    return float(image[image.shape[0] // 2, image.shape[1] // 4].mean()) / 255


def slide(tab: chromium.Browser, name: str, value: float) -> None:
    """Move a slider as a hand does, and wait for the picture of that wish."""
    before = tab.run(VERSION)
    element = f"document.getElementById('s-{name}')"
    tab.run(f"{element}.value = {value}; {element}.dispatchEvent(new Event('input'))")
    tab.wait(VERSION, lambda version: version > before)


def test_a_slider_moves_the_picture(page: chromium.Browser) -> None:
    for value in (0.15, 0.85):
        slide(page, "jawOpen", value)
        assert jaw(page) == pytest.approx(value, abs=0.04)
    assert page.run("document.querySelector('#s-jawOpen').closest('.row').querySelector('output').textContent") == "0.85"
    page.click("#reset")
    page.wait("document.querySelectorAll('.row.moved').length === 0")
    assert not page.complaints()


def test_a_key_on_a_slider_and_its_other_side(page: chromium.Browser, served: Server) -> None:
    page.run("document.getElementById('s-mouthSmileLeft').focus()")
    page.press("End")
    page.wait("+document.getElementById('s-mouthSmileRight').value === 1")
    page.run("document.getElementById('both').click()")
    slide(page, "mouthSmileLeft", 0.3)
    values = served.session.state()["sliders"]
    assert values["mouthSmileLeft"] == pytest.approx(0.3) and values["mouthSmileRight"] == 1
    page.run("document.getElementById('both').click()")


def test_dragging_the_picture_turns_the_head(page: chromium.Browser, served: Server) -> None:
    left, top, width, height = page.box("#picture")
    for kind, x in (("mousePressed", 0.5), ("mouseMoved", 0.6), ("mouseMoved", 0.7), ("mouseReleased", 0.7)):
        place = {"x": left + x * width, "y": top + height / 2}
        page.call("Input.dispatchMouseEvent", type=kind, button="left", buttons=1, clickCount=1, **place)
    page.wait("+document.getElementById('s-turn_right').value > 25")
    page.wait("!sending && !wish")
    assert served.session.state()["sliders"]["turn_right"] == pytest.approx(30, abs=2)


def test_the_clip_plays_and_stands_where_it_is_put(page: chromium.Browser) -> None:
    page.run("document.querySelector('[name=source][value=clip]').click()")
    page.wait("+document.getElementById('fps').textContent > 2")
    page.wait("document.getElementById('where').textContent", lambda text: text.startswith("frame "))
    page.click("#play")
    page.wait("document.getElementById('play').textContent === 'Play' && !sending && !wish")
    page.run("(p => { p.value = 10; p.dispatchEvent(new Event('input')); })(document.getElementById('place'))")
    page.wait("document.getElementById('where').textContent === 'frame 10, test'")
    assert jaw(page) == pytest.approx(10 / 11, abs=0.04)
    assert not page.complaints()


def test_a_file_is_taken_and_a_wrong_one_explained(page: chromium.Browser, tmp_path: Path) -> None:
    for name, text in (("bad.csv", "x\n0\n"), ("wave.csv", "jawOpen\n0\n1\n")):
        (tmp_path / name).write_text(text)
        node = page.call("DOM.querySelector", nodeId=page.call("DOM.getDocument")["root"]["nodeId"], selector="#file")["nodeId"]
        page.call("DOM.setFileInputFiles", files=[str(tmp_path / name)], nodeId=node)
        if name == "bad.csv":
            assert page.wait("!document.getElementById('error').hidden && document.getElementById('error').textContent") == (
                "bad.csv: the column x is not known"
            )
    page.wait("state.source === 'file' && document.getElementById('error').hidden")
    assert page.run("document.getElementById('filename').textContent") == "Playing wave.csv."


def test_a_webcam_drives_and_is_let_go(page: chromium.Browser) -> None:
    page.run("document.querySelector('[name=source][value=camera]').click()")
    page.wait("state.source === 'camera' && document.getElementById('times').innerText.includes('solve')")
    page.wait("document.getElementById('preview').complete && document.getElementById('preview').naturalWidth > 100")
    assert page.run("document.getElementById('mirror').checked")
    image = page.picture("#picture")  # mirrored: the jaw's half is on the right
    assert image[image.shape[0] // 2, 3 * image.shape[1] // 4].mean() / 255 == pytest.approx(0.7, abs=0.08)
    page.click("#neutral")
    page.run("document.querySelector('[name=source][value=sliders]').click()")
    page.wait("state.source === 'sliders' && camera === null && eye.srcObject === null")
    assert not page.complaints()


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (1280, True), (390, False), (390, True)])
def test_screens(tab: chromium.Browser, served: Server, width: int, dark: bool) -> None:
    visit(tab, served.address, width, 844, dark)
    assert tab.run("document.documentElement.scrollWidth") <= width
    wide = tab.run("[...document.querySelectorAll('body *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1)"
                   ".map(e => e.outerHTML.slice(0, 120))")  # fmt: skip
    assert not wide, wide
    assert "synthetic rendering of ann <b>" in tab.run("document.body.innerText")
    picture = tab.picture()
    assert bool(picture[2, 2].mean() < 60) is dark and len(np.unique(picture @ [65536, 256, 1])) > 30
    assert tab.box(".frame")[2] > (500 if width > 600 else 280)
    assert not tab.complaints()


def test_a_program_that_ended_is_told(tab: chromium.Browser) -> None:
    with session() as running:
        server = Server(running, html(running), lambda name, data: {})
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        visit(tab, server.address)
        server.shutdown()
        server.server_close()
    tab.run("want({strength: 0.5})")
    tab.wait("!document.getElementById('over').hidden && document.getElementById('over').textContent.includes('has ended')")
