"""CSS that the pages share: light, dark and printed; a module so that the code digest sees a change."""
# ruff: noqa: E501 - lines of CSS

STYLE = """
:root { color-scheme: light dark; --back: #f6f7f9; --card: #fff; --ink: #16202e; --soft: #566274; --line: #dfe4ea; --mark: #0b6bcb;
  --warm: #9a3412; --warm-back: #fff3e8; --shade: #eef2f6; --s0: #0b6bcb; --s1: #c2410c; --s2: #0f766e; --s3: #7c3aed;
  --s4: #a16207; --s5: #be185d; --p: #64748b; }
@media (prefers-color-scheme: dark) { :root { --back: #0f141b; --card: #171e28; --ink: #e8edf4; --soft: #9fb0c3; --line: #2b3644;
  --mark: #66b3ff; --warm: #fdba74; --warm-back: #2d2018; --shade: #1f2833; --s0: #66b3ff; --s1: #fb923c; --s2: #2dd4bf;
  --s3: #c4b5fd; --s4: #facc15; --s5: #f472b6; --p: #94a3b8; } }
* { box-sizing: border-box; }
html { scroll-padding-top: .8rem; }
body { margin: 0; background: var(--back); color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main, header, footer { max-width: 1180px; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 2.2rem; }
h1 { font-size: clamp(1.7rem, 4vw, 2.4rem); line-height: 1.15; letter-spacing: -.02em; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; letter-spacing: -.01em; margin: 0 0 .3rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; overflow-wrap: anywhere; }
p { margin: 0 0 1rem; } p, li, summary, code, figcaption, h2, nav a, footer { overflow-wrap: anywhere; }
.soft, figcaption, caption { color: var(--soft); font-size: .9rem; }
.after { margin: 1rem 0 .6rem; }
nav { display: flex; flex-wrap: wrap; gap: .3rem 1.1rem; padding: 1rem 0 0; font-size: .9rem; }
a { color: var(--mark); }
a:focus-visible, button:focus-visible, summary:focus-visible, input:focus-visible, select:focus-visible, video:focus-visible,
  .scroll:focus-visible { outline: 3px solid var(--mark); outline-offset: 2px; border-radius: 4px; }
button, select { font: inherit; font-size: .9rem; color: var(--ink); background: var(--shade); border: 1px solid var(--line);
  border-radius: 8px; padding: .35rem .7rem; min-height: 2.4rem; cursor: pointer; }
button:hover, select:hover { border-color: var(--mark); }
section { background: var(--card); border: 1px solid var(--line); border-radius: 14px; padding: 1.3rem 1.4rem; margin: 1.2rem 0; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.2rem, 1fr)); gap: .8rem; margin: 1.3rem 0 0; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 12px; padding: .8rem 1rem; }
.tile b { display: block; font-size: 1.45rem; letter-spacing: -.02em; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .84rem; overflow-wrap: anywhere; }
figure { margin: 0 0 1.2rem; }
figcaption { margin-top: .35rem; }
video, img { display: block; width: 100%; height: auto; border-radius: 8px; background: #fff; border: 1px solid var(--line); }
.narrow { max-width: 44rem; }
.plot { background: #fff; padding: .4rem; border-radius: 8px; border: 1px solid var(--line); }
.plot img { border: 0; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .9rem; }
caption { text-align: left; padding-bottom: .5rem; }
th, td { text-align: right; padding: .42rem .45rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th:last-child, td:last-child { padding-right: 0; }
td { vertical-align: baseline; }
tr > th[scope=row], thead tr:first-child > th:first-child { text-align: left; padding-left: 0; }
.scroll th[scope=row], .scroll th[rowspan], .scroll th.text-column:first-child { position: sticky; left: 0; background: var(--card); z-index: 1; padding-right: .7rem; }
th[rowspan] { vertical-align: bottom; } table.parts { width: auto; } .parts td, .parts thead th { padding: .42rem .5rem; } .parts th[rowspan] { padding-left: 0; }
thead th { color: var(--soft); font-weight: 600; font-size: .84rem; }
thead .group { text-align: left; padding-bottom: 0; border-bottom: 0; }
.start { border-left: 1px solid var(--line); padding-left: .8rem; }
.best { font-weight: 700; }
.best::after { content: " \\2605"; color: var(--mark); font-size: .75em; }
.spread { display: block; color: var(--soft); font-size: .82em; }
.tag { font-weight: 400; font-size: .72rem; border: 1px solid var(--line); border-radius: 99px; padding: .08rem .5rem; color: var(--soft); margin-left: .4rem;
  white-space: nowrap; }
th .tag { display: table; margin: .15rem 0 0; }
.tag.bad { color: var(--warm); border-color: var(--warm); }
.warnings { background: var(--warm-back); border-left: 4px solid var(--warm); border-radius: 6px; padding: .7rem 1rem .7rem 2rem; margin: 0; }
.two { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 0 2rem; }
dl { display: grid; grid-template-columns: minmax(8rem, 17rem) 1fr; gap: .35rem 1.2rem; margin: 0; font-size: .93rem; }
dt { color: var(--soft); overflow-wrap: anywhere; } dd { margin: 0; overflow-wrap: anywhere; }
.bar { display: inline-block; height: .6rem; background: var(--mark); border-radius: 3px; vertical-align: middle; min-width: 2px; }
td.wide { width: 55%; text-align: left; }
pre { background: var(--shade); padding: .8rem 1rem; border-radius: 8px; overflow-x: auto; font-size: .84rem; margin: .4rem 0 1rem; }
details { margin: .5rem 0; } summary { cursor: pointer; padding: .3rem 0; }
footer { padding-bottom: 3rem; color: var(--soft); font-size: .88rem; }
@media (max-width: 560px) { main, header, footer { padding-left: .8rem; padding-right: .8rem; }
  section { padding: 1rem .9rem; border-radius: 10px; } dl { grid-template-columns: 1fr; gap: .1rem; } dd { margin-bottom: .6rem; }
  .tiles { grid-template-columns: 1fr 1fr; gap: .6rem; } }
@media print { :root { --back: #fff; --card: #fff; --ink: #000; --soft: #444; --line: #bbb; --mark: #0b4f96; --shade: #f2f2f2;
  --warm: #7c2d12; --warm-back: #fff; } body { font-size: 11pt; } nav, .controls, button { display: none !important; }
  section { border: 0; padding: .5rem 0; } figure, tr, .tile { break-inside: avoid; } .scroll { overflow: visible; }
  table { font-size: 7.5pt; } th, td { padding: .2rem .25rem; } }
"""
