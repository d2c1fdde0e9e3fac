"""The page of an avatar's uses as a Jinja template: one file, no network, no script."""
# ruff: noqa: E501 - lines of HTML

from avatar.report.page_template import HEAD

STYLE = """
video { width: auto; min-width: min(100%, 30rem); max-width: 100%; max-height: 80vh; }
/* Low videos: room for the browser's controls below the picture. */
video { min-height: 10rem; object-fit: contain; object-position: top; background: var(--shade); }
header .warnings { margin: .6rem 0 0; }
"""

PAGE = HEAD + f"<style>{STYLE}</style>" + """
</head>
<body>
<header>
<h1>{{ subject }}: uses of {{ variant }}</h1>
<p class="warnings" style="padding-left: 1rem">Synthetic: the heads on this page were rendered by a trained avatar, not filmed. The videos say so in their own files.</p>
<nav aria-label="Sections">{% for item in sections %}<a href="#{{ item.id }}">{{ item.title }}</a>{% endfor %}</nav>
</header>
<main>
{% for item in sections %}<section id="{{ item.id }}">
<h2>{{ item.title }}</h2>
{% if item.caption %}<p class="soft">{{ item.caption }}</p>{% endif %}
{% for video in item.videos %}<figure><video controls loop muted playsinline preload="auto" src="{{ video.file }}" aria-label="{{ item.title }}: {{ video.name }}"></video>
<figcaption><strong>{{ video.source }}</strong>{% if video.comment %} &middot; {{ video.comment }}{% else %} &middot; no note on its origin in the file{% endif %}</figcaption></figure>
{% endfor %}{% for picture in item.pictures %}<figure><img loading="lazy" src="{{ picture.file }}" alt="{{ item.title }}: {{ picture.name }}">
<figcaption><strong>{{ picture.source }}</strong></figcaption></figure>
{% endfor %}{% for report in item.reports %}<details{% if loop.first %} open{% endif %}><summary>{{ report.name }}</summary>
<dl>{% for name, value in report.facts %}<dt>{{ name }}</dt><dd>{{ value }}</dd>{% endfor %}</dl></details>
{% endfor %}</section>
{% endfor %}</main>
<footer>Made of <code>results/{{ subject }}/{{ variant }}/</code>.</footer>
</body>
</html>
"""  # fmt: skip
