"""The player as CSS, HTML (Jinja) and script; without script the video stands alone with the browser's own controls."""
# ruff: noqa: E501 - lines of CSS and HTML

PLAYER_STYLE = """
.player { position: relative; border-radius: 8px; }
.player:focus-visible { outline: 3px solid var(--mark); outline-offset: 6px; }
.js .player video { position: absolute; top: 0; left: 0; width: 2px; height: 2px; opacity: .01; border: 0; pointer-events: none; }
.controls, .panels, .hint { display: none; } .js .hint { display: flex; flex-wrap: wrap; gap: .2rem .9rem; } .js .panels { display: flex; } .js .controls { display: flex; }
.panels { flex-wrap: wrap; justify-content: center; align-items: flex-end; gap: .8rem; --across: var(--columns, 2); }
.panels figure { margin: 0; min-width: 0; width: min(calc((100% - (var(--across) - 1) * .8rem - 1px) / var(--across)), max(17rem, 62vh) * var(--aspect)); } .panels.natural figure { width: min(100%, var(--natural)); }
.panels figure[hidden] { display: none; }
.panels figcaption { margin: 0 0 .3rem; display: flex; flex-wrap: wrap; gap: 0 .6rem; color: var(--ink); font-size: .9rem; }
.panels figcaption strong { overflow-wrap: anywhere; }
.panels .here { color: var(--soft); font-variant-numeric: tabular-nums; }
.panels .here span { white-space: nowrap; }
.panels .here .best { color: var(--ink); }
canvas { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 8px; }
canvas.difference { background: #000; filter: brightness(3); }
.controls { flex-wrap: wrap; align-items: center; gap: .5rem .6rem; margin: .8rem 0 0; }
.controls button { min-width: 2.6rem; } .controls svg { display: block; margin: auto; fill: currentColor; }
.controls button[aria-pressed=true] { background: var(--mark); color: var(--card); border-color: var(--mark); }
.controls .primary { background: var(--mark); color: var(--card); border-color: var(--mark); min-width: 3.4rem; }
.controls label { display: inline-flex; align-items: center; gap: .4rem; font-size: .9rem; min-height: 2.4rem; cursor: pointer; }
.controls input[type=checkbox] { width: 1.1rem; height: 1.1rem; accent-color: var(--mark); }
.controls input[type=range] { flex: 1 1 100%; width: 100%; height: 1.9rem; margin: 0; accent-color: var(--mark); cursor: pointer; touch-action: none; }
.where { margin-left: auto; font-variant-numeric: tabular-nums; font-size: .95rem; }
.chart { width: 100%; margin-top: .3rem; }
.chart .curve { display: block; flex: 1 1 100%; width: 100%; height: 150px; cursor: crosshair; touch-action: pan-y; background: var(--shade); border-radius: 8px; }
.chart text { fill: var(--soft); font-size: 11px; paint-order: stroke; stroke: var(--shade); stroke-width: 4px; stroke-linejoin: round; } .chart .grid { stroke: var(--line); } .chart .now { stroke: var(--ink); stroke-width: 1.5; }
.line { fill: none; stroke-width: 2; } .hint { margin: .6rem 0 0; color: var(--soft); font-size: .86rem; }
kbd { font: .84em ui-monospace, monospace; border: 1px solid var(--line); border-bottom-width: 2px; border-radius: 4px; padding: 0 .3rem; background: var(--shade); }
.jump { display: none; } .js .jump { display: inline-block; padding: .1rem .6rem; min-height: 0; font-size: .84rem; margin-left: .4rem; }
@media (max-width: 560px) { .panels { --across: min(var(--columns, 2), 2); } .panels figcaption { flex-direction: column; } .panels .here { font-size: .8rem; }
  .controls select.metric { max-width: 13rem; } .where { margin-left: 0; flex-basis: 100%; } }
@media print { .panels { display: flex; } .js .hint { display: none; } }
"""

PLAYER = """
<noscript><p class="warnings" style="padding-left:1rem">Without JavaScript the player is a plain video, its tiles row by row: {{ player.order }}.</p></noscript>
<div class="player" role="group" tabindex="0" aria-label="Player: input and renders in step" aria-describedby="keys">
<video class="alone" muted playsinline preload="auto" controls loop src="{{ player.file }}" aria-label="input and renders, tile by tile"></video>
<div class="panels" style="--aspect: {{ player.data.width / player.data.height }}; --natural: {{ player.data.width + 2 }}px">
{% for panel in player.data.panels %}<figure data-panel="{{ loop.index0 }}"{% if not panel.shown %} hidden{% endif %}>
<figcaption><span><strong>{{ panel.name }}</strong>{% if panel.kind == 'predictor' %}<span class="tag">predictor</span>{% endif %}</span><span class="here"></span></figcaption>
<canvas width="{{ player.data.width }}" height="{{ player.data.height }}" role="img" aria-label="{{ panel.name }}{% if panel.kind != 'input' %}: render{% endif %}"></canvas>
</figure>
{% endfor %}</div>
<div class="controls">
<input type="range" class="scrub" min="0" max="{{ player.data.frames | length - 1 }}" step="1" value="0" aria-label="Frame">
<button type="button" class="back" aria-label="One frame back" title="One frame back"><svg width="16" height="16" viewBox="0 0 16 16" aria-hidden="true"><path d="M2 2h2v12H2zM14 2v12L5 8z"/></svg></button>
<button type="button" class="play primary" aria-label="Play" title="Play or pause"><svg width="18" height="16" viewBox="0 0 16 16" aria-hidden="true"><path d="M3 1v14l11-7z"/></svg></button>
<button type="button" class="on" aria-label="One frame on" title="One frame on"><svg width="16" height="16" viewBox="0 0 16 16" aria-hidden="true"><path d="M12 2h2v12h-2zM2 2v12l9-6z"/></svg></button>
<button type="button" class="loop" aria-pressed="true" title="Begin again at the end">loop</button>
<label>speed <select class="speed"><option value="0.1">0.1 &times;</option><option value="0.25">0.25 &times;</option><option value="0.5">0.5 &times;</option><option value="1" selected>1 &times;</option><option value="2">2 &times;</option></select></label>
<label title="Absolute difference from the input, three times as bright"><input type="checkbox" class="differ">difference &times; 3</label>
<label title="One pixel of the render on one of the screen, where there is room"><input type="checkbox" class="size">full size</label>
<output class="where" aria-live="off"></output>
</div>
<div class="controls chart">
<label><span>error of each frame</span> <select class="metric" aria-label="Metric of the curve">{% for metric in player.data.metrics %}<option value="{{ metric.key }}">{{ metric.title }} ({{ metric.better }})</option>{% endfor %}</select></label>
{% for panel in player.data.panels[1:] %}<label><input type="checkbox" class="show" value="{{ loop.index }}"{% if panel.shown %} checked{% endif %}><svg width="30" height="10" aria-hidden="true"><line class="line" x1="0" x2="30" y1="5" y2="5" style="stroke:var({{ panel.colour }})"{% if panel.dash %} stroke-dasharray="{{ panel.dash }}"{% endif %}/></svg>{{ panel.name }}</label>
{% endfor %}<svg class="curve" role="img" aria-label="Error of each frame; click to go there"></svg>
</div>
<p class="hint" id="keys"><span>In the player:</span><span><kbd>space</kbd> play, pause</span><span><kbd>&larr;</kbd> <kbd>&rarr;</kbd> one frame</span>
<span><kbd>shift</kbd>+<kbd>&larr;</kbd> <kbd>&rarr;</kbd> ten</span><span><kbd>home</kbd> <kbd>end</kbd> first, last</span><span>A click on the curve goes to that frame.</span></p>
</div>
<script type="application/json" id="player-data">{{ player.data | tojson }}</script>
"""
