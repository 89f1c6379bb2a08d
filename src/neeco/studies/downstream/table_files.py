"""Tables of the downstream study as LaTeX, CSV of means, and the files of all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from neeco.files import write_text
from neeco.studies.tables import ResultTable, cell_texts, csv_text

LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def summary_csv(keys: Sequence[str], metrics: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV of rows with `keys` and a `study.spread` by metric, as METRIC_mean, METRIC_std and METRIC_n."""
    parts = ("mean", "std", "n")
    flat = [
        {**row, **{f"{metric}_{part}": row[metric][part] for metric in metrics if metric in row for part in parts}}
        for row in rows
    ]
    return csv_text([*keys, *(f"{metric}_{part}" for metric in metrics for part in parts)], flat)


def latex_table(table: ResultTable, caption: str) -> str:
    """The table in LaTeX for the package booktabs; the best of a column is bold."""
    import pandas

    headings, rows = cell_texts(table, latex_escape, r"\textbf{{{}}}", "failed")
    columns = "l" * len(table.keys) + "r" * (len(headings) - len(table.keys))
    style = pandas.DataFrame(rows, columns=headings).style.hide(axis="index")
    caption = latex_escape(caption)
    return str(style.to_latex(hrules=True, position_float="centering", caption=caption, column_format=columns))


def latex_document(caption: str, tables: Sequence[ResultTable], lead: Sequence[str], notes: Sequence[str]) -> str:
    """LaTeX tables for the package booktabs. caption: with {} for a table's title; lead, notes: comments."""
    comments = [["% " + " ".join(text.split()) for text in texts] for texts in (lead, notes)]
    parts = ["% \\usepackage{booktabs}", *comments[0], ""]
    parts += [latex_table(table, caption.replace("{}", table.title)) for table in tables]
    return "\n".join([*parts, *comments[1]]).rstrip() + "\n"


def latex_escape(text: str) -> str:
    """`text` so that LaTeX prints it as it stands."""
    return "".join(LATEX_SPECIAL.get(character, character) for character in text)


def write_files(
    output: Path, stem: str, texts: Mapping[str, str], data: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Write `texts` by suffix as STEM.csv, STEM.md and STEM.tex into `output`, and `data` by name into its data/."""
    files = {output / f"{stem}.{suffix}": text for suffix, text in texts.items()}
    for path, text in (files | {output / "data" / name: text for name, text in data.items()}).items():
        write_text(path, text)
