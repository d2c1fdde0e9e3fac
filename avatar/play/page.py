"""The page of `play`: one self-contained HTML, made with Jinja; its style and script stand in modules beside this one."""
# ruff: noqa: E501 - lines of HTML

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from jinja2 import Environment
from markupsafe import Markup

from avatar.play.page_script import SCRIPT
from avatar.play.page_style import PAGE_STYLE
from avatar.play.sliders import Slider

TITLES = {"sliders": "Sliders", "clip": "Own clip", "file": "Parameter file", "video": "Video", "camera": "Webcam"}

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ facts.subject }}: {{ facts.variant }}, live</title>
<link rel="icon" href="data:,">
<style nonce="{{ nonce }}">{{ style }}</style>
</head>
<body>
<header>
<h1>{{ facts.subject }} <span class="soft">{{ facts.variant }}</span></h1>
<p class="meters" role="status" aria-live="off"><span class="meter"><b id="fps">&ndash;</b> frames a second</span>
<span class="meter"><b id="draw">&ndash;</b> ms to draw</span></p>
</header>
<main>
<section class="stage">
<div class="frame"><canvas id="picture" width="{{ width }}" height="{{ height }}" role="img" tabindex="0"
 aria-label="Synthetic rendering of {{ facts.subject }}; drag to turn the head"></canvas>
<p class="badge">synthetic rendering of {{ facts.subject }}</p>
<p class="over" id="over" hidden></p>
<figure class="driver" id="driver" hidden><img id="preview" alt="The driver, small, with the landmarks that were found"><figcaption id="note"></figcaption></figure></div>
<div class="transport">
<button type="button" id="play" class="primary" aria-pressed="true">Pause</button>
<input type="range" id="place" min="0" max="1" step="1" value="0" aria-label="Frame" hidden>
<output id="where"></output>
<label><input type="checkbox" id="mirror"> mirror</label>
<label>size <select id="size">{% for size in facts.sizes %}<option value="{{ size }}">{{ size }} px</option>{% endfor %}</select></label>
</div>
{% if not facts.live %}<p class="hint" id="slow">A <em>{{ facts.representation }}</em> avatar is a field: its rays are marched, which
takes far longer than drawing layers. It draws about <b id="able">&ndash;</b> frames a second at this size; a smaller picture is faster.</p>{% endif %}
<dl class="times" id="times"></dl>
</section>
<aside>
<section class="source"><h2>Moved by</h2>
<div class="choice" role="radiogroup" aria-label="What moves the head">
{% for name, title in titles.items() %}<label><input type="radio" name="source" value="{{ name }}"><span>{{ title }}</span></label>
{% endfor %}</div>
<p class="hint" data-for="sliders">Nothing plays: the sliders below move the resting face. Drag over the picture to turn the head.</p>
<p class="hint" data-for="clip">The track of {{ facts.subject }}'s own video, frame by frame. The sliders are added to it.</p>
<div data-for="file"><p class="hint">A CSV or NPZ of named columns, as <code>animate</code> reads it. <span id="filename">{% if facts.file %}Playing {{ facts.file }}.{% endif %}</span></p>
<label class="pick"><span>Choose a file</span><input type="file" id="file" accept=".csv,.npz"></label></div>
<div data-for="video"><p class="hint">A video of a face drives the avatar, yours or another's; ask before you show anyone's face moved by somebody else.
{% if facts.video %}Playing {{ facts.video }}.{% endif %}</p></div>
<div data-for="camera"><p class="hint">Your face drives the avatar. Pictures go to the program on this computer, nowhere else, and are not kept.</p>
<label class="pick"><span>Use a video file instead</span><input type="file" id="film" accept="video/*"></label></div>
<div data-for="video camera" class="driving">
<button type="button" id="neutral" title="Look straight with a resting face, then press">Set neutral</button>
<button type="button" id="calibrate" title="Forget this face and get to know the next">Another face</button>
<label><input type="checkbox" id="smooth"> smooth</label></div>
{% if not facts.detector %}<p class="hint">Video and webcam need resources/assets/face_landmarker.task, which is missing: run snakemake once.</p>{% endif %}
<p class="error" id="error" role="alert" hidden></p>
</section>
<section class="sliders"><div class="top"><h2>Sliders</h2>
<label title="Move the left and the right side together"><input type="checkbox" id="both" checked> both sides</label>
<button type="button" id="reset">Reset all</button></div>
<div class="row"><label for="strength">strength</label><input type="range" id="strength" min="0" max="2" step="0.01" value="1"><output for="strength">1.00</output></div>
{% for group, items in groups.items() %}<details{% if loop.index <= 5 %} open{% endif %}><summary>{{ group }}<button type="button" class="undo" data-group="{{ group }}" title="Reset {{ group }}">reset</button></summary>
{% for s in items %}<div class="row" data-group="{{ group }}"><label for="s-{{ s.name }}" title="{{ s.name }}">{{ s.label }}</label>
<input type="range" id="s-{{ s.name }}" class="slider" data-name="{{ s.name }}"{% if s.twin %} data-twin="{{ s.twin }}"{% endif %} min="{{ s.low }}" max="{{ s.high }}" step="any" value="{{ s.rest }}" data-rest="{{ s.rest }}"{% if s.seen %} data-seen="{{ s.seen[0] }} {{ s.seen[1] }}"{% endif %}><output for="s-{{ s.name }}"></output></div>
{% endfor %}</details>
{% endfor %}<p class="hint">The darker part of a slider is what training saw (1st to 99th percentile); beyond it the avatar guesses.</p>
</section>
</aside>
</main>
<footer>avatar sha256 {{ facts.sha256[:16] }} &middot; {{ facts.representation }} &middot; drawn on this computer</footer>
<script type="application/json" id="facts" nonce="{{ nonce }}">{{ data | tojson }}</script>
<script nonce="{{ nonce }}">{{ script }}</script>
</body>
</html>
"""


def html(facts: dict[str, Any], state: Callable[[], dict[str, Any]], nonce: str) -> str:
    """The page.

    Args:
        facts: see `avatar.play.assembly.page_facts`; state: what is chosen now.
        nonce: of its style and scripts.
    """
    groups: dict[str, list[Slider]] = {}
    for slider in facts["sliders"]:
        groups.setdefault(slider.group, []).append(slider)
    now = state()
    height = round(now["size"] / facts["aspect"]) if facts["aspect"] >= 1 else now["size"]
    width = now["size"] if facts["aspect"] >= 1 else round(now["size"] * facts["aspect"])
    data = {name: value for name, value in facts.items() if name != "sliders"} | {"state": now}
    values = {"facts": facts, "groups": groups, "nonce": nonce, "data": data, "titles": TITLES, "width": width, "height": height}
    environment = Environment(autoescape=True, keep_trailing_newline=True)
    return environment.from_string(PAGE).render(style=_safe(PAGE_STYLE), script=_safe(SCRIPT), **values)


def _safe(text: str) -> Markup:
    """Our own text, not to be escaped."""
    return Markup(text)
