"""The page over all subjects as a Jinja template; without script the table is there, unsorted."""
# ruff: noqa: E501 - lines of CSS and HTML

from avatar.report.page_template import HEAD

STYLE = """
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 19rem), 1fr)); gap: 1rem; margin: 1.2rem 0; padding: 0; list-style: none; }
.cards li { background: var(--card); border: 1px solid var(--line); border-radius: 14px; overflow: hidden; display: flex; flex-direction: column; }
.cards img { border: 0; border-radius: 0; border-bottom: 1px solid var(--line); aspect-ratio: 2; object-fit: cover; object-position: top; }
.cards a:hover { text-decoration: none; }
.none { aspect-ratio: 2; display: grid; place-items: center; background: var(--shade); color: var(--soft); border-bottom: 1px solid var(--line); font-size: .9rem; }
.text { padding: .9rem 1.1rem 1rem; } .text h2 { font-size: 1.1rem; overflow-wrap: anywhere; } .text p { margin: .3rem 0 0; font-size: .9rem; }
.figures { display: flex; flex-wrap: wrap; gap: .1rem 1rem; font-variant-numeric: tabular-nums; }
.reason { color: var(--warm); white-space: normal; text-align: left; }
.reason div { position: sticky; left: 8rem; max-width: min(48rem, 100vw - 13rem); }
th button { font: inherit; color: inherit; background: none; border: 0; padding: .2rem 0; min-height: 0; white-space: nowrap; }
th button::after { content: " \\2195"; opacity: .5; } [aria-sort=ascending] button::after { content: " \\25b2"; opacity: 1; }
[aria-sort=descending] button::after { content: " \\25bc"; opacity: 1; }
th.text-column, td.text-column { text-align: left; padding-left: 0; padding-right: 1rem; }
td.none-text { color: var(--soft); }
"""

SCRIPT = r"""
(() => {
'use strict';
// Inside Snakemake's report each page has a folder named by a hash.
if (/\/data\/raw\/[0-9a-f]{16}\/index\.html$/.test(location.pathname))
  document.querySelectorAll('a[data-report]').forEach(link => { link.href = link.dataset.report; });
const table = document.getElementById('table'), body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
const value = (row, column) => { const cell = row.cells[column]; return cell && cell.dataset.value; };
heads.forEach((head, column) => {
  const button = document.createElement('button');
  button.type = 'button';
  button.textContent = head.textContent;
  button.title = 'Sort by this column';
  head.replaceChildren(button);
  button.addEventListener('click', () => {
    const down = head.getAttribute('aria-sort') === 'ascending', words = column < 2;
    heads.forEach(each => each.removeAttribute('aria-sort'));
    head.setAttribute('aria-sort', down ? 'descending' : 'ascending');
    const order = [...body.rows].sort((one, other) => {
      const a = value(one, column), b = value(other, column);
      if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);   // without a figure: last
      return (words ? a.localeCompare(b) : a - b) * (down ? -1 : 1);
    });
    body.append(...order);
  });
});
})();
"""

PAGE = HEAD + f"<style>{STYLE}</style>" + """
</head>
<body>
<header>
<h1>{{ title }}</h1>
<p class="soft">{{ summary }}</p>
<nav aria-label="Sections"><a href="#subjects">Subjects</a><a href="#scores">Table</a>{% if plots %}<a href="#plots">Plots</a>{% endif %}</nav>
</header>
<main>
<ul class="cards" id="subjects">
{% for card in cards %}<li>
{% if card.picture %}<a href="{{ card.link }}" data-report="{{ card.report_link }}"><img src="{{ card.picture }}" alt="{{ card.subject }}: input beside the render of {{ card.best or 'a predictor' }}" loading="lazy"></a>
{% else %}<div class="none">no picture</div>{% endif %}
<div class="text"><h2>{% if card.link %}<a href="{{ card.link }}" data-report="{{ card.report_link }}">{{ card.subject }}</a>{% else %}{{ card.subject }}{% endif %}
{%- if card.status != 'ok' %}<span class="tag bad">{{ card.status }}</span>{% endif %}</h2>
{% if card.figures %}<p class="soft">best avatar: {{ card.best }}</p><p class="figures">{% for title, value in card.figures %}<span>{{ title }} <strong>{{ value }}</strong></span>{% endfor %}</p>{% endif %}
{% for note in card.notes %}<p class="reason">{{ note | replace(card.status ~ ': ', '', 1) }}</p>{% endfor %}</div>
</li>
{% endfor %}</ul>
<section id="scores">
<h2>All scores</h2>
<p class="soft">Means over each subject's scored test frames; arrows say which way is better, the best of each subject is bold with a star.
<a href="{{ csv }}" download>This table as CSV</a>, with deviations and counts.</p>
<noscript><p class="soft">Columns sort where JavaScript runs. Inside report.zip, open the subjects' pages from the report's own menu.</p></noscript>
<div class="scroll" tabindex="0" role="region" aria-label="All scores"><table id="table">
<thead><tr><th scope="col" class="text-column">subject</th><th scope="col" class="text-column">variant</th>{% for column in columns %}<th scope="col">{{ column }}</th>{% endfor %}</tr></thead>
<tbody>
{% for row in rows %}<tr><th scope="row" data-value="{{ row.subject }}">{{ row.subject }}</th><td class="text-column" data-value="{{ row.variant }}">{{ row.variant or 'all' }}{% if row.kind %}<span class="tag">{{ row.kind }}</span>{% endif %}</td>
{% if row.cells %}{% for cell in row.cells %}<td{% if cell.value is not none %} data-value="{{ cell.value }}"{% else %} class="none-text" title="{{ row.note }}"{% endif %}><span{% if cell.best %} class="best"{% endif %}>{{ cell.text }}</span></td>{% endfor %}
{% else %}<td class="reason" colspan="{{ columns | length or 1 }}"><div><strong>{{ row.status }}</strong>: {{ row.note | replace(row.status ~ ': ', '', 1) }}</div></td>{% endif %}</tr>
{% endfor %}</tbody></table></div>
{% if notes %}<h3>Notes</h3><ul>{% for note in notes %}<li>{{ note }}</li>{% endfor %}</ul>{% endif %}
{% if protocols %}<details><summary>Protocol</summary>{% for line in protocols %}<p>{{ line }}</p>{% endfor %}</details>{% endif %}
</section>
{% if plots %}<section id="plots">
<h2>Plots</h2>
{% for item in plots %}<figure class="plot"><img src="{{ item.file }}" alt="{{ item.alt }}"></figure>
{% endfor %}</section>{% endif %}
</main>
<footer>The renders on these pages are synthetic: made by trained avatars, not filmed.</footer>
<script>""" + SCRIPT + """</script>
</body>
</html>
"""  # fmt: skip
