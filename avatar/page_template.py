"""The subject's page as a Jinja template: one file, no network, no script; a module so that the code digest sees a change."""
# ruff: noqa: E501 - lines of CSS and HTML

STYLE = """
:root { color-scheme: light dark; --back: #f6f7f9; --card: #fff; --ink: #16202e; --soft: #566274; --line: #dfe4ea; --mark: #0b6bcb;
  --warm: #9a3412; --warm-back: #fff3e8; --shade: #eef2f6; }
@media (prefers-color-scheme: dark) { :root { --back: #0f141b; --card: #171e28; --ink: #e8edf4; --soft: #9fb0c3; --line: #2b3644;
  --mark: #66b3ff; --warm: #fdba74; --warm-back: #2d2018; --shade: #1f2833; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--back); color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main, header, footer { max-width: 1180px; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 2.5rem; }
h1 { font-size: clamp(1.7rem, 4vw, 2.4rem); line-height: 1.15; letter-spacing: -.02em; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; letter-spacing: -.01em; margin: 0 0 .3rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; }
p { margin: 0 0 1rem; }
.soft, figcaption, caption { color: var(--soft); font-size: .9rem; }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.1rem; padding: 1rem 0 0; font-size: .9rem; }
a { color: var(--mark); }
section { background: var(--card); border: 1px solid var(--line); border-radius: 14px; padding: 1.3rem 1.4rem; margin: 1.2rem 0; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.2rem, 1fr)); gap: .8rem; margin: 1.3rem 0 0; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 12px; padding: .8rem 1rem; }
.tile b { display: block; font-size: 1.45rem; letter-spacing: -.02em; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .84rem; }
figure { margin: 0 0 1.2rem; }
figcaption { margin-top: .35rem; }
video, img { display: block; width: 100%; height: auto; border-radius: 8px; background: #fff; border: 1px solid var(--line); }
.videos { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 27rem), 1fr)); gap: .4rem 1.4rem; }
.lead { grid-column: 1 / -1; }
.heads { display: grid; grid-auto-flow: column; grid-auto-columns: 1fr; text-align: center; margin: 0 0 .3rem; }
.plot { background: #fff; padding: .4rem; border-radius: 8px; border: 1px solid var(--line); }
.plot img { border: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .9rem; }
caption { text-align: left; padding-bottom: .5rem; }
th, td { text-align: right; padding: .42rem .45rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th:last-child, td:last-child { padding-right: 0; }
td { vertical-align: baseline; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
thead th { color: var(--soft); font-weight: 600; font-size: .84rem; }
.best { font-weight: 700; }
.best::after { content: " \\2605"; color: var(--mark); font-size: .75em; }
.spread { display: block; color: var(--soft); font-size: .82em; }
.tag { font-weight: 400; font-size: .72rem; border: 1px solid var(--line); border-radius: 99px; padding: .08rem .5rem; color: var(--soft); margin-left: .4rem; }
th .tag { display: table; margin: .15rem 0 0; }
.warnings { background: var(--warm-back); border-left: 4px solid var(--warm); border-radius: 6px; padding: .7rem 1rem .7rem 2rem; margin: 0; }
dl { display: grid; grid-template-columns: minmax(8rem, 17rem) 1fr; gap: .35rem 1.2rem; margin: 0; font-size: .93rem; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
.bar { display: inline-block; height: .6rem; background: var(--mark); border-radius: 3px; vertical-align: middle; min-width: 2px; }
td.wide { width: 55%; text-align: left; }
pre { background: var(--shade); padding: .8rem 1rem; border-radius: 8px; overflow-x: auto; font-size: .84rem; margin: .4rem 0 1rem; }
details { margin: .5rem 0; } summary { cursor: pointer; padding: .3rem 0; }
footer { padding-bottom: 3rem; color: var(--soft); font-size: .88rem; }
@media (max-width: 560px) { section { padding: 1rem; border-radius: 10px; } dl { grid-template-columns: 1fr; gap: .1rem; }
  dd { margin-bottom: .6rem; } }
"""

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ subject }}: head avatar</title>
<link rel="icon" href="data:,">
<style>{{ style | safe }}</style>
</head>
<body>
<header>
<h1>{{ subject }}</h1>
<p class="soft">{{ summary }}</p>
<div class="tiles">
{% for tile in tiles %}<div class="tile"><b>{{ tile.value }}</b><span>{{ tile.label }}</span></div>
{% endfor %}</div>
<nav aria-label="Sections">
<a href="#videos">Videos</a><a href="#scores">Scores</a><a href="#frames">Worst and best frames</a><a href="#plots">Plots</a>
<a href="#tracking">Tracking</a><a href="#capture">Capture</a><a href="#trim">Matte</a><a href="#time">Time</a>
<a href="#protocol">Protocol</a><a href="#reproduce">Reproduce</a>
</nav>
</header>
<main>
<section id="videos">
<h2>Input beside render</h2>
<p class="soft">Test frames only: none of them was seen in training. Both sides on white.</p>
<div class="videos">
{% for item in videos %}<figure{% if item.lead %} class="lead"{% endif %}>
<figcaption class="heads"><span>input</span><span>{{ item.variant }}{% if item.predictor %}<span class="tag">predictor</span>{% endif %}</span>
</figcaption>
<video controls loop muted playsinline preload="auto" src="{{ item.file }}" aria-label="input beside {{ item.variant }}"></video>
</figure>
{% endfor %}</div>
</section>
<section id="scores">
<h2>Scores</h2>
<div class="scroll"><table>
<caption>Mean over the scored test frames, standard deviation over frames in small figures; the best of each column is bold with a star.
</caption>
<thead><tr><th scope="col">variant</th>{% for column in columns %}<th scope="col">{{ column }}</th>{% endfor %}</tr></thead>
<tbody>
{% for row in rows %}<tr><th scope="row">{{ row.variant }}{% if row.predictor %}<span class="tag">predictor</span>{% endif %}</th>
{% for cell in row.cells %}<td><span{% if cell.best %} class="best"{% endif %}>{{ cell.value }}</span>
{%- if cell.spread %}<span class="spread">&plusmn;{{ cell.spread }}</span>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
<p class="soft" style="margin-top: .8rem">{{ excluded }} A predictor is no avatar: <em>mean_frame</em> is the mean training frame,
<em>nearest_frame</em> the training frame nearest in expression and pose.</p>
</section>
<section id="frames">
<h2>Worst and best frames</h2>
<p class="soft">Input, render, and absolute error (black is none, pale yellow {{ error_range }} of the range or more), chosen by LPIPS.</p>
{% for group in groups %}<h3>{{ group.variant }}</h3>
{% for item in group.strips %}<figure>
<img loading="lazy" src="{{ item.file }}" width="{{ item.width }}" height="{{ item.height }}" alt="{{ item.alt }}">
<figcaption><strong>{{ item.rank }}</strong> &middot; {{ item.caption }}</figcaption></figure>
{% endfor %}{% endfor %}
</section>
<section id="plots">
<h2>Plots</h2>
{% for item in plots %}<figure class="plot"><img src="{{ item.file }}" alt="{{ item.alt }}"></figure>
{% endfor %}</section>
<section id="tracking">
<h2>Tracking</h2>
<figure><video controls loop muted playsinline preload="auto" src="overlay.mp4" aria-label="tracked mesh over the video"></video>
<figcaption>The fitted head over the input.</figcaption></figure>
<h3>What this clip does not determine</h3>
{% if unknown %}<ul>{% for line in unknown %}<li>{{ line }}</li>{% endfor %}</ul>{% else %}<p>Nothing was reported.</p>{% endif %}
<h3>What the fit decided, and why</h3>
<dl>{% for name, value in decisions %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
<h3>Fit in figures</h3>
<dl>{% for name, value in fit %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
</section>
<section id="capture">
<h2>Capture</h2>
{% if warnings %}<p class="soft">What would make this avatar better:</p>
<ul class="warnings">{% for line in warnings %}<li>{{ line }}</li>{% endfor %}</ul>
{% else %}<p>The clip follows the capture protocol: nothing to remark.</p>{% endif %}
<h3>The video</h3>
<dl>{% for name, value in probe %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
</section>
<section id="trim">
<h2>Matte</h2>
<p class="soft">As filmed, the opacity that training and scoring use (head and neck), and the two together on white.</p>
{% for item in trims %}<figure><img loading="lazy" src="{{ item.file }}" width="{{ item.width }}" height="{{ item.height }}"
 alt="{{ item.alt }}"><figcaption>{{ item.caption }}</figcaption></figure>
{% endfor %}</section>
<section id="time">
<h2>Time</h2>
<div class="scroll"><table><thead><tr><th scope="col">stage</th><th scope="col">seconds</th><th scope="col"></th></tr></thead><tbody>
{% for item in stages %}<tr><th scope="row">{{ item.name }}</th><td>{{ item.seconds }}</td>
<td class="wide"><span class="bar" style="width:{{ item.percent }}%"></span></td></tr>
{% endfor %}</tbody></table></div>
<p class="soft" style="margin-top: .8rem">{{ machine }}</p>
{% for item in trainings %}<details><summary>Training of {{ item.variant }}</summary>
<dl>{% for name, value in item.facts %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
{% endfor %}</section>
<section id="protocol">
<h2>Protocol</h2>
<dl>{% for name, value in protocol %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
</section>
<section id="reproduce">
<h2>Reproduce</h2>
<p>With <code>{{ source }}</code> in the folder of videos and this configuration:</p>
<pre>snakemake results/{{ subject }}/page</pre>
<details><summary>Configuration and code of each stage</summary>
{% for item in provenance %}<h3>{{ item.name }} <span class="soft">code {{ item.code }}</span></h3><pre>{{ item.config }}</pre>
{% endfor %}</details>
<details><summary>Versions</summary><dl>{% for name, value in versions %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
</section>
</main>
<footer>The renders on this page are synthetic: made by a trained avatar, not filmed.</footer>
</body>
</html>
"""
