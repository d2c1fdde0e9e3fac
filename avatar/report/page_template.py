"""The subject's page as a Jinja template: one file, no network; a module so that the code digest sees a change."""
# ruff: noqa: E501 - lines of HTML

from avatar.report.player_script import SCRIPT
from avatar.report.player_template import PLAYER, PLAYER_STYLE

HEAD = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title>
<link rel="icon" href="data:,">
<style>{{ style | safe }}</style>
"""

TABLES = """
{% for table in tables %}<p class="soft{% if not loop.first %} after{% endif %}">{% if loop.first %}Mean over the scored test frames, standard deviation over frames in small figures; the best of each column is bold with a star.{% else %}The same frames, inside {{ table.name }} only.{% endif %}</p>
<div class="scroll" tabindex="0" role="region" aria-label="Scores of {{ table.name }}"><table{% if not loop.first %} class="parts"{% endif %}>
<thead><tr><th scope="col" rowspan="2">variant</th>{% for group in table.groups %}<th scope="colgroup" class="group{% if not loop.first %} start{% endif %}" colspan="{{ group.titles | length }}">{{ group.title }}</th>{% endfor %}</tr>
<tr>{% for group in table.groups %}{% set first = loop.first %}{% for title in group.titles %}<th scope="col"{% if loop.first and not first %} class="start"{% endif %}>{{ title }}</th>{% endfor %}{% endfor %}</tr></thead>
<tbody>
{% for row in table.rows %}<tr><th scope="row">{{ row.variant }}{% if row.predictor %}<span class="tag">predictor</span>{% endif %}</th>
{% for cell in row.cells %}<td{% if cell.start %} class="start"{% endif %}><span{% if cell.best %} class="best"{% endif %}>{{ cell.value }}</span>
{%- if cell.spread %}<span class="spread">&plusmn;{{ cell.spread }}</span>{% endif %}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endfor %}"""

BODY = (
    """
<section id="scores">
<h2>Scores</h2>
"""
    + TABLES
    + """
<p class="soft after">{{ excluded }} A predictor is no avatar: <em>mean_frame</em> is the mean training frame,
<em>nearest_frame</em> the training frame nearest in expression and pose.</p>
</section>
<section id="limits">
<h2>What limits this avatar</h2>
<div class="two"><div>
<h3>Capture: what would make it better</h3>
{% if warnings %}<ul class="warnings">{% for line in warnings %}<li>{{ line }}</li>{% endfor %}</ul>
{% else %}<p>The clip follows the capture protocol: nothing to remark.</p>{% endif %}
</div><div>
<h3>What this clip does not determine</h3>
{% if unknown %}<ul>{% for line in unknown %}<li>{{ line }}</li>{% endfor %}</ul>{% else %}<p>Nothing was reported.</p>{% endif %}
</div></div>
</section>
<section id="frames">
<h2>Worst frames first</h2>
<p class="soft">Input, render, and absolute error (black is none, pale yellow {{ error_range }} of the range or more), chosen by LPIPS.</p>
{% for group in groups %}<h3>{{ group.variant }}</h3>
{% for item in group.strips %}<figure>
<img loading="lazy" src="{{ item.file }}" width="{{ item.width }}" height="{{ item.height }}" alt="{{ item.alt }}">
<figcaption><strong>{{ item.rank }}</strong> &middot; {{ item.caption }}<button type="button" class="jump" data-frame="{{ item.frame }}" data-variant="{{ group.variant }}">show in the player</button></figcaption></figure>
{% endfor %}{% endfor %}
</section>
<section id="plots">
<h2>Curves</h2>
{% for item in plots %}<figure class="plot"><img loading="lazy" src="{{ item.file }}" alt="{{ item.alt }}"></figure>
{% endfor %}</section>
<section id="tracking">
<h2>Tracking</h2>
<figure class="narrow"><video controls loop muted playsinline preload="auto" src="overlay.mp4" aria-label="tracked mesh over the video"></video>
<figcaption>The fitted head over the input, the whole clip.</figcaption></figure>
<h3>What the fit decided, and why</h3>
<dl>{% for name, value in decisions %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
<details><summary>Fit in figures</summary>
<dl>{% for name, value in fit %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
<details><summary>The video</summary>
<dl>{% for name, value in probe %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
</section>
<section id="trim">
<h2>Matte</h2>
<p class="soft">As filmed, the opacity that training and scoring use (head and neck), and the two together on white.</p>
{% for item in trims %}<figure><img loading="lazy" src="{{ item.file }}" width="{{ item.width }}" height="{{ item.height }}"
 alt="{{ item.alt }}"><figcaption>{{ item.caption }}</figcaption></figure>
{% endfor %}</section>
<section id="protocol">
<h2>Protocol</h2>
<dl>{% for name, value in protocol %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
</section>
<section id="time">
<h2>Time</h2>
<div class="scroll" tabindex="0" role="region" aria-label="Seconds of each stage"><table><thead><tr><th scope="col">stage</th><th scope="col">seconds</th><td></td></tr></thead><tbody>
{% for item in stages %}<tr><th scope="row">{{ item.name }}</th><td>{{ item.seconds }}</td>
<td class="wide"><span class="bar" style="width:{{ item.percent }}%"></span></td></tr>
{% endfor %}</tbody></table></div>
<p class="soft after">{{ machine }}</p>
{% for item in trainings %}{% if item.decisions %}<h3>What the budget of {{ item.variant }} decided, and why</h3>
<dl>{% for name, value in item.decisions %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl>
{% endif %}<details><summary>Training of {{ item.variant }}</summary>
<dl>{% for name, value in item.facts %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
{% endfor %}</section>
<section id="reproduce">
<h2>Reproduce</h2>
<p>With <code>{{ source }}</code> in the folder of videos and this configuration:</p>
<pre>snakemake results/{{ subject }}/page</pre>
<details><summary>Configuration and code of each stage</summary>
{% for item in provenance %}<h3>{{ item.name }} <span class="soft">code {{ item.code }}</span></h3><pre>{{ item.config }}</pre>
{% endfor %}</details>
<details><summary>Versions</summary><dl>{% for name, value in versions %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
</section>
"""
)

PAGE = HEAD + f"<style>{PLAYER_STYLE}</style>" + """
</head>
<body>
<header>
<h1>{{ subject }}</h1>
<p class="soft">{{ summary }}</p>
<div class="tiles">
{% for tile in tiles %}<div class="tile"><b>{{ tile.value }}</b><span>{{ tile.label }}</span></div>
{% endfor %}</div>
<nav aria-label="Sections">
<a href="#player">Player</a><a href="#scores">Scores</a><a href="#limits">Limits</a><a href="#frames">Worst frames</a>
<a href="#plots">Curves</a><a href="#tracking">Tracking</a><a href="#trim">Matte</a><a href="#protocol">Protocol</a>
<a href="#time">Time</a><a href="#reproduce">Reproduce</a>
</nav>
</header>
<main>
<section id="player">
<h2>Input beside render</h2>
<p class="soft">Test frames only: none of them was seen in training. All on white.</p>
""" + PLAYER + """</section>
""" + BODY + """</main>
<footer>The renders on this page are synthetic: made by a trained avatar, not filmed. {{ player.comment }}</footer>
<script>""" + SCRIPT + """</script>
</body>
</html>
"""  # fmt: skip
