"""LaTeX tables with booktabs: escaping, marks, notes, layout. Pure text."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from avatar.report.tables import BEST, SECOND

SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "_": r"\_", "&": r"\&", "%": r"\%", "#": r"\#", "$": r"\$",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    '"': "''", "±": r"$\pm$", "×": r"$\times$", "↓": r"$\downarrow$", "↑": r"$\uparrow$",
    "–": "--", "—": "---", "…": r"\ldots{}", "’": "'", "“": "``", "”": "''",
}  # fmt: skip
"""What LaTeX reads as something else, or cannot set as it is."""
KNOWN_UP_TO = "\u017f"
"""pdfLaTeX's own UTF-8 table has Latin letters with accents to here; other scripts need a Unicode engine."""
COMMANDS = {BEST: "textbf", SECOND: "underline"}


def escape(text: str) -> str:
    """Text as LaTeX sets it: special characters escaped, line breaks as spaces.

    A letter that pdfLaTeX cannot set is itself under XeLaTeX and LuaLaTeX, and its code point (U+65E5) under pdfLaTeX, so that
    a name in any script compiles everywhere.
    """
    text = " ".join(unicodedata.normalize("NFC", text).split())
    pieces = re.split(f"([^\\x00-{KNOWN_UP_TO}±×↓↑–—…’“”]+)", text)
    return "".join(_foreign(piece) if place % 2 else _latin(piece) for place, piece in enumerate(pieces))


def _latin(text: str) -> str:
    return "".join(SPECIAL.get(letter, letter) for letter in text if letter.isprintable())


def _foreign(text: str) -> str:
    codes = "~".join(f"U+{ord(letter):04X}" for letter in text)
    return rf"\ifdefined\Umathcode {text}\else {codes}\fi{{}}"


def marked(text: str, rank: int) -> str:
    """A figure, the best bold, the second underlined."""
    return rf"\{COMMANDS[rank]}{{{escape(text)}}}" if rank in COMMANDS else escape(text)


@dataclass
class Notes:
    """Sentences under a table, numbered; the same sentence has the same number."""

    sentences: dict[str, int] = field(default_factory=dict)

    def mark(self, text: str, sentence: str) -> str:
        """The text, LaTeX already, with the raised number of the sentence."""
        number = self.sentences.setdefault(sentence, len(self.sentences) + 1)
        return rf"{text}\textsuperscript{{{number}}}"

    def lines(self) -> list[str]:
        """The sentences, for the foot of the table."""
        return [rf"\textsuperscript{{{number}}}\,{escape(text)}" for text, number in self.sentences.items()]


@dataclass(frozen=True)
class Group:
    """Rows of a tabular under one title (`""`: none); a row is a list of cells that are LaTeX already."""

    title: str
    rows: Sequence[Sequence[str]]


def tabular(header: Sequence[Sequence[str]], groups: Sequence[Group]) -> list[str]:
    """Lines of a tabular in the paper's layout: names left, one column an item, groups under a centred title.

    Raises:
        ValueError: a row has another number of cells than the header.
    """
    width = len(header[0])
    for row in (*header, *(row for group in groups for row in group.rows)):
        if len(row) != width:
            raise ValueError(f"a row of {len(row)} cells in a table of {width}: {row}")
    lines = [rf"\begin{{tabular}}{{l{'|c' * (width - 1)}}}", r"\toprule", *(_row(row) for row in header)]
    for group in groups:
        lines.append(r"\midrule")
        if group.title:
            lines += [rf"\multicolumn{{{width}}}{{c}}{{\footnotesize \textit{{{group.title}}}}} \\", r"\midrule"]
        lines += [_row(row) for row in group.rows]
    return [*lines, r"\bottomrule", r"\end{tabular}"]


def _row(cells: Sequence[str]) -> str:
    return " & ".join(cells) + r" \\"


def table(
    tabulars: Sequence[Sequence[str]],
    caption: str,
    label: str,
    notes: Sequence[str] = (),
    wide: bool = True,
    tabcolsep_em: float = 0.5,
) -> list[str]:
    """Lines of a floating table of one or more tabulars under each other. caption and notes are LaTeX already."""
    name = "table*" if wide else "table"
    lines = [rf"\begin{{{name}}}[!t]", r"\centering", r"\small", rf"\setlength{{\tabcolsep}}{{{tabcolsep_em:g}em}}"]
    for place, block in enumerate(tabulars):
        lines += [r"\par\vspace{0.8em}"] * bool(place) + list(block)
    if notes:
        width = r"\textwidth" if wide else r"\columnwidth"
        lines += [rf"\par\vspace{{0.3em}}\begin{{minipage}}{{{width}}}\footnotesize\raggedright"]
        lines += [rf"{note}\par" for note in notes] + [r"\end{minipage}"]
    return [*lines, rf"\caption{{{caption}}}", rf"\label{{{label}}}", rf"\end{{{name}}}"]


def comment(lines: Sequence[str]) -> list[str]:
    """Lines that LaTeX skips."""
    return [f"% {line}".rstrip() for text in lines for line in text.splitlines() or [""]]


def document(packages: Mapping[str, str], about: Sequence[str], tables: Sequence[Sequence[str]]) -> str:
    """A file to be read by `\\input`: what it needs and means as a comment, then the tables."""
    needs = [rf"\usepackage{{{name}}}  ({why})" for name, why in packages.items()]
    top = comment(["To be read by \\input. Needs in the preamble:", *needs, *about])
    return "\n\n".join(["\n".join(lines) for lines in (top, *tables)]) + "\n"
