"""LaTeX: every name and sentence compiles, rows have the columns of their table, braces and groups close."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from test_tabulate import make, result, write

from avatar.report import latex, tables
from avatar.report.latex import Group, Notes

NASTY = r"a_b & 50% #1 $x$ {y} ~ ^ \z <|> “q” … ± ×"
NAMES = ("ann_1", "Zoë", "花子", "Łódź", "Анна", "e\u0301mile", "a&b%c#d$e{f}g~h^i", "x" * 30)


def rows_of(text: str) -> list[list[tuple[int, int]]]:
    """Of each tabular: columns it has, and columns that each of its rows fills."""
    found = []
    for columns, body in re.findall(r"\\begin\{tabular\}\{([lc|]+)\}\n(.*?)\\end\{tabular\}", text, re.S):
        width, rows = len(columns.replace("|", "")), []
        for line in body.splitlines():
            if not line.endswith(r"\\"):
                assert line in (r"\toprule", r"\midrule", r"\bottomrule"), line
                continue
            spans = sum(int(count) - 1 for count in re.findall(r"\\multicolumn\{(\d+)\}", line))
            rows.append((width, len(re.split(r"(?<!\\)&", line)) + spans))
        found.append(rows)
    return found


def check(text: str) -> None:
    """Braces balance, environments close in order, each row fills its table, and nothing special is left as it is."""
    code = "\n".join(re.sub(r"(?<!\\)%.*", "", line) for line in text.splitlines())
    plain = re.sub(r"\\[{}]", "", code)
    depth = 0
    for letter in plain:
        depth += (letter == "{") - (letter == "}")
        assert depth >= 0
    assert depth == 0
    stack: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+\*?)\}", code):
        if kind == "begin":
            stack.append(name)
        else:
            assert stack.pop() == name
    assert not stack
    assert code.count(r"\ifdefined") == code.count(r"\else") == len(re.findall(r"\\fi\b", code))
    tabulars = rows_of(code)
    assert tabulars
    assert all(width == filled for rows in tabulars for width, filled in rows), tabulars
    assert not re.search(r"(?<!\\)[#~]", re.sub(r"\\else .*?\\fi", "", code))  # a tie stands between code points only
    assert "nan" not in re.sub(r"[^\W\d]{4,}", "", code).lower()


def test_escaping() -> None:
    assert latex.escape("a_b & c") == r"a\_b \& c"
    assert latex.escape(NASTY) == (
        r"a\_b \& 50\% \#1 \$x\$ \{y\} \textasciitilde{} \textasciicircum{} \textbackslash{}z "
        r"\textless{}\textbar{}\textgreater{} ``q'' \ldots{} $\pm$ $\times$"
    )
    assert latex.escape("e\u0301mile") == "émile" and latex.escape("two\nlines\x07") == "two lines"
    assert latex.escape("花子_1") == r"\ifdefined\Umathcode 花子\else U+82B1~U+5B50\fi{}\_1"


def test_marks_and_notes() -> None:
    marks = [latex.marked("0.1", rank) for rank in (tables.BEST, tables.SECOND, tables.REST)]
    assert marks == [r"\textbf{0.1}", r"\underline{0.1}", "0.1"]
    notes = Notes()
    assert [notes.mark("failed", words) for words in ("dark", "short_", "dark")] == [
        rf"failed\textsuperscript{{{number}}}" for number in (1, 2, 1)
    ]
    assert notes.lines() == [r"\textsuperscript{1}\,dark", r"\textsuperscript{2}\,short\_"]


def test_rows_must_fill_the_table() -> None:
    with pytest.raises(ValueError, match="a row of 2 cells in a table of 3"):
        latex.tabular([["", "a", "b"]], [Group("", [["x", "1"]])])


@pytest.mark.parametrize(
    ("texts", "best", "expected"),
    [
        ({"a": "0.1", "b": "0.2", "c": "0.3"}, min, [0, 1, 2]),
        ({"a": "0.1", "b": "0.2", "c": "0.3"}, max, [2, 1, 0]),
        ({"a": "9.5", "b": "10.0", "c": "10.00", "d": "9.5", "e": "1"}, max, [1, 0, 0, 1, 2]),  # as numbers; ties alike
        ({"a": "0.1"}, min, [2]),
        ({"a": "0.1", "b": "0.1"}, min, [0, 0]),
    ],
)
def test_ranks(texts: dict[str, str], best, expected: list[int]) -> None:
    assert list(tables.ranks(texts, best).values()) == expected


def scored(number: int) -> dict[str, dict]:
    return {
        "demo_a": result(0.1 + number / 100, 0.9, 26.0 + number, seconds=600.0),
        "mean_frame": result(0.3, 0.8, 20.0, True, excluded=number % 2),
    }


def nasty_subjects(root: Path) -> dict[str, list[Path]]:
    """Every name, one of them without a variant, and a rejected video with a nasty reason."""
    results = {name.replace("/", ""): scored(number) for number, name in enumerate(NAMES)}
    del results["Zoë"]["demo_a"]
    return write(root, dict.fromkeys(NAMES) | {"bob": NASTY}, results, regions=True)


def test_tables_are_sound_whatever_the_names(tmp_path: Path) -> None:
    text = make(tmp_path, nasty_subjects(tmp_path))
    for name in ("latex", "regions_latex"):
        check(text[name])
        assert len(rows_of(text[name])) == 3  # nine subjects and their mean, four beside each other
        assert latex.escape(NASTY) in text[name] and r"rejected\textsuperscript" in text[name]
        assert "not made" in text[name]


def test_layout_of_table_1(tmp_path: Path) -> None:
    """Variants down, subjects across, `LPIPS / SSIM / PSNR` in each cell, as in the paper."""
    subjects = write(tmp_path, {"ann": None, "eve": None}, {"ann": scored(0), "eve": scored(1)})
    text = make(tmp_path, subjects)["latex"]
    check(text)
    lines = text.splitlines()
    assert r" & \textit{ann} & \textit{eve} & \textit{Mean of 2} \\" in lines
    header = r"\scriptsize LPIPS$\downarrow$ / SSIM$\uparrow$ / PSNR$\uparrow$"
    assert rf"\scriptsize PSNR in dB & {header} & {header} & {header} \\" in lines
    best = [["0.100", "0.900", "26.00"], ["0.110", "0.900", "27.00"], ["0.105", "0.900", "26.50"]]
    figures = [" / ".join(rf"\textbf{{{figure}}}" for figure in cell) for cell in best]
    assert rf"demo\_a & {' & '.join(figures)} \\" in lines
    second = r"\underline{0.300} / \underline{0.800} / \underline{20.00}"
    assert rf"mean\_frame$^\ast$ & {second} & {second} & {second} \\" in lines
    assert r"Test frames & 10 & 10, 10 of 11 & 2 of 2 subjects \\" in lines
    assert r"demo\_a & 80.0 / 600 & 80.0 / 600 & not averaged \\" in lines
    assert "background: white" in text.split(r"\caption")[1] and "%   resolution: 64x64" in text


@pytest.mark.skipif(not shutil.which("pdflatex"), reason="no LaTeX here")
def test_it_compiles(tmp_path: Path) -> None:
    text = make(tmp_path, nasty_subjects(tmp_path))
    (tmp_path / "a.tex").write_text(text["latex"], encoding="utf-8")
    (tmp_path / "b.tex").write_text(text["regions_latex"], encoding="utf-8")
    rules = "\n".join(rf"\newcommand{{\{name}rule}}{{\hline}}" for name in ("top", "mid", "bottom"))
    needs = rf"\IfFileExists{{booktabs.sty}}{{\usepackage{{booktabs}}}}{{{rules}}}"
    page = rf"\documentclass{{article}}{needs}\begin{{document}}\input{{a}}\input{{b}}\end{{document}}"
    (tmp_path / "page.tex").write_text(page)
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout.decode(errors="replace")[-2000:]
