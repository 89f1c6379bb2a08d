"""Tables of a sweep: means over seeds by configuration, or differences to a reference beside published ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neeco.base.errors import counted
from neeco.base.files import write_text
from neeco.studies.configurations import COSTS, MEASURES, Study, Table, TableRow
from neeco.studies.machine import machine_words
from neeco.studies.study import spread
from neeco.studies.sweep import Rows, SweepPlan, failures
from neeco.studies.tables import (
    UNKNOWN,
    Cell,
    Column,
    ResultTable,
    Row,
    SummaryRow,
    markdown_document,
    summary_table,
)

Numbers = Mapping[str, Mapping[str, Any]]  # `study.spread` by configuration and measure, of one split
PRIMARY = "test"  # the split that published numbers are compared with, where there is one


def tables_of(plan: SweepPlan, rows: Rows) -> list[tuple[str, str, ResultTable]]:
    """Return (name, split, numbers) of the study's tables: one with published numbers for the primary split alone, the
    others for each split; at last ("", "", the cost of the runs)."""
    study, splits = plan.study, plan.splits
    finished = {row["configuration"] for row in rows if not row.get("error")}
    reasons = {row["configuration"]: row["error"] for row in rows if row["configuration"] not in finished}
    numbers = {split: summary(rows, split) for split in splits}
    found = []
    for name, table in study.tables.items():
        primary = PRIMARY if PRIMARY in splits else splits[0]
        for split in [primary] if any(row.published for row in table.rows.values()) else splits:
            title = f"{table.title}, {split}"
            if table.reference is None:
                made = _means(title, table, numbers[split], reasons)
            else:
                made = _differences(title, table, numbers[split], reasons, study.even_db)
            found.append((name, split, made))
    keys = tuple(column.key for column in COSTS)
    costs = Table(measures=keys, rows={name: TableRow() for name in study.configurations})
    return [*found, ("", "", _means("Training and rendering", costs, numbers[splits[0]], reasons))]


def summary(rows: Rows, split: str) -> Numbers:
    """Return mean, standard deviation and number of the seeds that finished, by configuration and measure."""
    runs: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        runs.setdefault(row["configuration"], []).extend([row] if row["split"] == split else [])
    return {name: {key: spread(row.get(key) for row in of_name) for key in MEASURES} for name, of_name in runs.items()}


def direction(ours: float | None, published: float, even: float) -> str:
    """Compare the signs of two differences: "yes", "no", "even" where ours is below `even`, UNKNOWN."""
    if ours is None:
        return UNKNOWN
    return "even" if abs(ours) < even else "yes" if (ours > 0) == (published > 0) else "no"


def _means(title: str, table: Table, numbers: Numbers, reasons: Mapping[str, str]) -> ResultTable:
    """Mean ± standard deviation; the best is marked, columns without any number are left out."""
    entries = table.rows.items()
    rows = [SummaryRow((row.label or name,), numbers[name], reasons.get(name)) for name, row in entries]
    return summary_table(title, ("configuration",), [MEASURES[key] for key in table.measures], rows)


def _differences(title: str, table: Table, numbers: Numbers, reasons: Mapping[str, str], even: float) -> ResultTable:
    """Means with their differences to the reference; of a measure with published numbers also these, and whether both
    differ in the same direction."""
    reference = str(table.reference)
    columns: list[Column] = []
    cells: dict[str, list[Cell]] = {name: [] for name in table.rows}
    for at, column in enumerate(MEASURES[key] for key in table.measures):
        published = {name: row.published[at] for name, row in table.rows.items() if len(row.published) > at}
        titles = [f"{column.title}: published", "ours", "agrees"] if published else [column.title]
        columns += [Column(column.key, text) for text in titles]
        base = numbers[reference][column.key]["mean"]
        limit = even if "psnr" in column.key else 0.0  # which is in dB
        for name in table.rows:
            mean, std = (numbers[name][column.key][part] for part in ("mean", "std"))
            change = None if name == reference or mean is None or base is None else mean - base
            text = UNKNOWN if mean is None else column.written(mean)
            text += "" if std is None else f" ± {column.written(std)}"
            text += "" if change is None else f" ({change * column.scale:+.{column.digits}f})"
            words = [text]
            if published:
                both = name != reference and {name, reference} <= published.keys()
                agrees = direction(change, published[name] - published[reference], limit) if both else ""
                words = [column.written(published[name]) if name in published else UNKNOWN, text, agrees]
            cells[name] += map(Cell, words)
    rows = tuple(
        Row((row.label or name,), tuple(cells[name]), reasons.get(name), reference=name == reference)
        for name, row in table.rows.items()
    )
    return ResultTable(title, ("configuration",), tuple(columns), rows)


def length_words(study: Study) -> str:
    """Return the length of the runs and the number of seeds, in words."""
    lengths = dict.fromkeys(study.length_of(name) for name in study.configurations)
    each = " or ".join(f"{value:,g} {key.replace('cpu_', 'CPU ')}" for key, value in lengths)
    return f"{each} each, {counted(study.seeds, 'seed')}"


def write_tables(plan: SweepPlan, rows: Rows) -> Path:
    """Write table.md into the output and return its path."""
    file, name = plan.request.output / "table.md", plan.capture.root.absolute().name
    tables = [table for _, _, table in tables_of(plan, rows)]
    lead = f"{length_words(plan.study)}. {machine_words(plan.machine)}."
    compared = (table for table in plan.study.tables.values() if table.reference is not None)
    references = [f"{table.rows[str(table.reference)].label or table.reference} ({table.title})" for table in compared]
    if references:
        lead += f" In brackets: the difference to {', '.join(references)}."
    notes = [*plan.notes, *(f"failed: {line}" for line in failures(rows))]
    write_text(file, markdown_document(f"{plan.study.title}: {name}", lead, tables, "seeds", notes))
    return file
