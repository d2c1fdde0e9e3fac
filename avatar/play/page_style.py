"""CSS of the page of `play`; colours are those of the report's pages."""
# ruff: noqa: E501 - lines of CSS

PAGE_STYLE = """
:root { color-scheme: light dark; --back: #f6f7f9; --card: #fff; --ink: #16202e; --soft: #566274; --line: #dfe4ea; --mark: #0b6bcb;
  --warm: #9a3412; --warm-back: #fff3e8; --shade: #eef2f6; --seen: #b9d4f0; --rail: #dfe4ea; }
@media (prefers-color-scheme: dark) { :root { --back: #0f141b; --card: #171e28; --ink: #e8edf4; --soft: #9fb0c3; --line: #2b3644;
  --mark: #66b3ff; --warm: #fdba74; --warm-back: #2d2018; --shade: #1f2833; --seen: #2f5378; --rail: #2b3644; } }
* { box-sizing: border-box; } [hidden] { display: none !important; }
body { margin: 0; background: var(--back); color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
header, main, footer { max-width: 1320px; margin: 0 auto; padding: 0 1.1rem; }
header { display: flex; flex-wrap: wrap; align-items: baseline; justify-content: space-between; gap: .2rem 1.5rem; padding-top: .8rem; padding-bottom: .6rem; }
h1 { font-size: 1.45rem; letter-spacing: -.02em; margin: 0; overflow-wrap: anywhere; } h1 .soft { font-weight: 400; }
h2 { font-size: 1rem; margin: 0; } .soft { color: var(--soft); }
.meters { display: flex; gap: 1.4rem; margin: 0; color: var(--soft); font-size: .9rem; }
.meter b { color: var(--ink); font-size: 1.35rem; letter-spacing: -.02em; font-variant-numeric: tabular-nums; }
main { display: grid; grid-template-columns: minmax(0, 1fr) 25rem; gap: 1rem; align-items: start; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 14px; padding: 1rem; }
aside { display: flex; flex-direction: column; gap: 1rem; height: calc(100vh - 5.2rem); position: sticky; top: .8rem; }
.stage { position: sticky; top: .8rem; }
.frame { position: relative; max-width: calc((100vh - 15rem) * var(--aspect, 1)); min-width: min(100%, 18rem); margin: 0 auto; }
canvas { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 10px; cursor: grab; touch-action: none; }
canvas:active { cursor: grabbing; } canvas.mirrored { transform: scaleX(-1); }
.badge { position: absolute; left: .6rem; bottom: .6rem; margin: 0; padding: .1rem .6rem; border-radius: 99px; background: rgb(22 32 46 / .72); color: #fff; font-size: .78rem; pointer-events: none; }
.over { position: absolute; inset: 0; margin: auto; height: fit-content; width: fit-content; max-width: 90%; padding: .5rem 1rem; border-radius: 8px; background: rgb(22 32 46 / .8); color: #fff; text-align: center; }
.driver { position: absolute; right: .6rem; top: .6rem; width: 24%; margin: 0; pointer-events: none; }
.driver img { display: block; width: 100%; border-radius: 8px; border: 1px solid #fff; background: #000; } .driver.mirrored img { transform: scaleX(-1); }
.driver figcaption { font-size: .78rem; color: #16202e; background: rgb(255 255 255 / .8); border-radius: 6px; padding: 0 .35rem; margin-top: .2rem; width: fit-content; } .driver figcaption:empty { display: none; }
.transport { display: flex; flex-wrap: wrap; align-items: center; gap: .5rem .9rem; margin-top: .8rem; }
.transport input[type=range] { flex: 1 1 12rem; }
#where { color: var(--soft); font-variant-numeric: tabular-nums; font-size: .9rem; margin-right: auto; }
.hint { color: var(--soft); font-size: .86rem; margin: .5rem 0 0; overflow-wrap: anywhere; }
.times { display: flex; flex-wrap: wrap; gap: .1rem 1.1rem; margin: .6rem 0 0; font-size: .84rem; color: var(--soft); min-height: 1.5em; }
.times div { display: flex; gap: .35rem; } dt, dd { margin: 0; } dd { color: var(--ink); font-variant-numeric: tabular-nums; }
label { display: inline-flex; align-items: center; gap: .4rem; font-size: .9rem; cursor: pointer; }
button, select { font: inherit; font-size: .9rem; color: var(--ink); background: var(--shade); border: 1px solid var(--line); border-radius: 8px; padding: .3rem .75rem; min-height: 2.3rem; cursor: pointer; }
button:hover:not(:disabled), select:hover { border-color: var(--mark); } button:disabled { opacity: .5; cursor: default; }
.primary { background: var(--mark); border-color: var(--mark); color: var(--card); min-width: 5rem; }
input[type=checkbox], input[type=radio] { accent-color: var(--mark); width: 1.05rem; height: 1.05rem; margin: 0; }
:focus-visible { outline: 3px solid var(--mark); outline-offset: 2px; border-radius: 4px; }
.choice { display: flex; flex-wrap: wrap; gap: .4rem; margin-top: .6rem; }
.choice label { border: 1px solid var(--line); border-radius: 8px; padding: .3rem .7rem; min-height: 2.3rem; background: var(--shade); }
.choice input { position: absolute; opacity: 0; } .choice label:has(:checked) { background: var(--mark); border-color: var(--mark); color: var(--card); }
.choice label:has(:disabled) { opacity: .45; cursor: default; } .choice label:has(:focus-visible) { outline: 3px solid var(--mark); outline-offset: 2px; }
.pick { position: relative; margin-top: .6rem; } .pick input { position: absolute; inset: 0; opacity: 0; cursor: pointer; width: 100%; }
.pick span { border: 1px dashed var(--soft); border-radius: 8px; padding: .3rem .75rem; min-height: 2.3rem; } .pick:has(:focus-visible) span { outline: 3px solid var(--mark); outline-offset: 2px; }
.driving { display: flex; flex-wrap: wrap; gap: .5rem .8rem; align-items: center; margin-top: .7rem; }
.error { color: var(--warm); background: var(--warm-back); border-left: 4px solid var(--warm); border-radius: 6px; padding: .4rem .7rem; margin: .7rem 0 0; font-size: .9rem; overflow-wrap: anywhere; }
.top { display: flex; flex-wrap: wrap; align-items: center; gap: .5rem .9rem; } .top h2 { margin-right: auto; }
.sliders { flex: 1 1 0; min-height: 14rem; overflow-y: auto; padding-top: 0; }
.top { position: sticky; top: 0; z-index: 1; background: var(--card); padding: .8rem 0 .5rem; }
details { border-top: 1px solid var(--line); padding: .2rem 0 .4rem; } .sliders > .row { margin: .2rem 0 .5rem; }
summary { cursor: pointer; font-weight: 600; font-size: .92rem; padding: .25rem 0; }
summary .undo { float: right; min-height: 0; padding: .05rem .55rem; font-size: .8rem; font-weight: 400; }
.row { display: grid; grid-template-columns: 8.2rem minmax(0, 1fr) 3.2rem; align-items: center; gap: .6rem; min-height: 1.85rem; }
.row label { overflow-wrap: anywhere; line-height: 1.2; } .row output { text-align: right; font-variant-numeric: tabular-nums; font-size: .84rem; color: var(--soft); }
.row.moved output { color: var(--mark); font-weight: 600; }
input[type=range] { appearance: none; -webkit-appearance: none; width: 100%; height: 1.6rem; margin: 0; background: none; cursor: pointer; }
input[type=range]::-webkit-slider-runnable-track { height: 6px; border-radius: 3px; background: linear-gradient(to right, var(--rail) var(--from, 0%), var(--seen) var(--from, 0%), var(--seen) var(--to, 0%), var(--rail) var(--to, 0%)); }
input[type=range]::-moz-range-track { height: 6px; border-radius: 3px; background: linear-gradient(to right, var(--rail) var(--from, 0%), var(--seen) var(--from, 0%), var(--seen) var(--to, 0%), var(--rail) var(--to, 0%)); }
input[type=range]::-webkit-slider-thumb { appearance: none; -webkit-appearance: none; width: 16px; height: 16px; margin-top: -5px; border-radius: 50%; background: var(--mark); border: 2px solid var(--card); box-shadow: 0 0 0 1px var(--line); }
input[type=range]::-moz-range-thumb { width: 13px; height: 13px; border-radius: 50%; background: var(--mark); border: 2px solid var(--card); }
footer { color: var(--soft); font-size: .8rem; padding: .8rem 1.1rem 1.4rem; }
@media (max-width: 860px) { main { grid-template-columns: minmax(0, 1fr); gap: .7rem; } header, main, footer { padding-left: .7rem; padding-right: .7rem; }
  section { padding: .8rem; border-radius: 12px; } .stage { top: 0; z-index: 2; padding: .5rem .8rem; } .frame { max-width: min(100%, calc(46vh * var(--aspect, 1))); }
  aside { position: static; height: auto; gap: .7rem; } .sliders { flex: none; overflow: visible; padding-top: 0; } .top { position: static; } .stage .hint, .times { display: none; } .meters { font-size: .8rem; gap: .9rem; }
  .transport { margin-top: .5rem; gap: .4rem .7rem; } .row { min-height: 2.3rem; } }
"""
