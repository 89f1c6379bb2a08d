"""STUDY.yaml: the configurations of a sweep, and the tables of its results, as CSV of unrounded numbers, and rounded
for the terminal and pages. Without heavy imports."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import parse_yaml, read_text
from neeco.base.settings import Device, structure

UNKNOWN = "-"
Better = Literal["high", "low", None]


@dataclass(frozen=True)
class Column:
    """One column of a table: its key in the results, title, format, and direction of improvement."""

    key: str
    title: str
    digits: int = 0
    better: Better = None
    scale: float = 1.0

    def written(self, value: float) -> str:
        """Return `value` formatted for the table."""
        return f"{value * self.scale:,.{self.digits}f}"

    @property
    def heading(self) -> str:
        """The title with an arrow in the direction of improvement."""
        return self.title + {"high": " ↑", "low": " ↓", None: ""}[self.better]


@dataclass(frozen=True)
class Cell:
    """One entry as text, its standard deviation if known, and whether it is the best of its column."""

    text: str
    std: str = ""
    best: bool = False

    def __str__(self) -> str:
        return f"{self.text} ± {self.std}" if self.std else self.text


@dataclass(frozen=True)
class Row:
    """The row's keys (as many as the table has), its cells, or the reason for their absence."""

    keys: tuple[str, ...]
    cells: tuple[Cell, ...]
    failed: str | None = None
    reference: bool = False  # whether the others are compared with it


@dataclass(frozen=True)
class ResultTable:
    """A table with a title: columns `keys` identify a row, columns of numbers follow."""

    title: str
    keys: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


def summary_table(
    title: str, key: str, columns: Sequence[Column], rows: Sequence[tuple[str, Mapping[str, Any], str | None]]
) -> ResultTable:
    """Return mean ± standard deviation by row (key, numbers by column from `study.spread`, reason of failure) and
    column. Columns without any number are left out; the best means, as displayed, are marked if there are several
    rows."""
    used, best = [], {}
    for column in columns:
        means = [numbers[column.key]["mean"] for _, numbers, _ in rows if _has(numbers, column)]
        if means:
            used.append(column)
        if column.better is not None and len(means) > 1:
            best[column.key] = column.written(max(means) if column.better == "high" else min(means))

    def cell(numbers: Mapping[str, Any], column: Column) -> Cell:
        if not _has(numbers, column):
            return Cell(UNKNOWN)
        mean, std = (numbers[column.key][part] for part in ("mean", "std"))
        text = column.written(mean)
        return Cell(text, "" if std is None else column.written(std), text == best.get(column.key))

    made = (Row((name,), tuple(cell(numbers, column) for column in used), reason) for name, numbers, reason in rows)
    return ResultTable(title, (key,), tuple(used), tuple(made))


def _has(numbers: Mapping[str, Any], column: Column) -> bool:
    return bool(numbers.get(column.key) and numbers[column.key]["n"])


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return CSV with a header line, unrounded; missing values are empty, other keys than the columns are ignored."""
    import pandas

    table = pandas.DataFrame(list(rows), columns=list(columns), dtype=object)
    return str(table.to_csv(index=False, lineterminator="\n"))


SCORES = (  # of one split
    Column("psnr", "PSNR", 2, "high"),
    Column("ssim", "SSIM", 3, "high"),
    Column("lpips", "LPIPS", 3, "low"),
    Column("psnr_instrument", "PSNR instrument", 2, "high"),
    Column("mask_iou", "label IoU", 3, "high"),
    Column("mask_dice", "label Dice", 3, "high"),
)
MOMENTS = (
    *(Column(f"psnr_at_{percent}", f"PSNR at {percent} %", 2, "high") for percent in (20, 40, 60)),
    Column("phase_1_psnr", "phase-1 training PSNR", 2, "high"),
)
COSTS = (  # of a whole run
    Column("iterations", "iterations"),
    Column("seconds", "minutes", 2, None, 1 / 60),
    Column("fps", "FPS", 1, "high"),
    Column("num_gaussians", "Gaussians"),
)
MEASURES = {column.key: column for column in (*SCORES, *MOMENTS, *COSTS)}
LENGTHS = ("iterations", "minutes", "cpu_minutes")
MAX_NAME_BYTES = 200  # limit on the bytes of a configuration's name; its folder's name is longer, at most 255


@dataclass(frozen=True, kw_only=True)
class SweepRequest:
    """Arguments shared by `sweep`, `compare` and `ablate`."""

    capture: Annotated[Path, tyro.conf.Positional]
    """Capture folder."""
    output: Path
    """Folder to write; absent, empty, or of this study started earlier."""
    seeds: int | None = None
    """Number of seeds, from 0; with 2 or more the tables have standard deviations. Default: the study's, else 1."""
    iterations: int | None = None
    """Training steps of each run. Default: the study's."""
    minutes: float | None = None
    """Training time of each run, minutes of wall-clock time."""
    cpu_minutes: float | None = None
    """Training time of each run, minutes of CPU time summed over threads; comparable on a shared machine."""
    splits: tuple[str, ...] | None = None
    """Splits to score. Default: all but train."""
    workers: int = 1
    """Parallel runs, which share the cores. RAY_ADDRESS names a Ray cluster (needs the extra `cluster`)."""
    transforms: str = "transforms.json"
    """Transforms file of the capture to read."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A field of every run's training config, as NAME=VALUE (e.g. max_tissue_gaussians=5000); repeatable."""
    lpips_weights: Path | None = None
    """Folder with alexnet.safetensors and/or vgg16.safetensors. Default: NEECO_LPIPS_WEIGHTS."""
    device: Device = "auto"

    def check(self) -> None:
        """Raise NeecoError naming the invalid option."""
        if self.seeds is not None and self.seeds < 1:
            raise NeecoError(f"--seeds must be at least 1 (got {self.seeds})")
        if any(value is not None for value in self.lengths.values()):
            single_length(self.lengths, "--")

    @property
    def lengths(self) -> dict[str, Any]:
        """The lengths of a run by LENGTHS."""
        return {key: getattr(self, key) for key in LENGTHS}

    def run_folder(self, name: str, seed: int) -> Path:
        """Return the run folder of a configuration and seed."""
        return self.output / "runs" / f"{name}-seed{seed}"


@dataclass(frozen=True, kw_only=True)
class Configuration:
    """One training configuration."""

    method: str | None = None  # as for `neeco train --method`; METHOD+dta: with the paper's dynamic training adjustment
    like: str | None = None  # another configuration, whose method, settings and iterations are the defaults
    settings: tuple[str, ...] = ()  # NAME=VALUE as for `neeco train --set`
    iterations: int | None = None  # in place of the study's length


@dataclass(frozen=True, kw_only=True)
class TableRow:
    """One configuration in a table. published: published numbers for the first measures of the table; only the
    directions of their differences are compared with ours."""

    label: str = ""  # "": the configuration's name
    published: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Table:
    """Configurations to compare. `reference`: the one from which differences are computed."""

    title: str = ""
    text: str = ""
    reference: str | None = None
    measures: tuple[str, ...] = tuple(column.key for column in SCORES)
    rows: dict[str, TableRow] = field(default_factory=dict)  # by configuration


@dataclass(frozen=True, kw_only=True)
class Study:
    """Configurations x seeds. All runs have one length: `iterations`, `minutes` or `cpu_minutes`."""

    title: str = "Sweep"
    configurations: dict[str, Configuration] = field(default_factory=dict)
    seeds: int = 1  # number of seeds, from 0
    iterations: int | None = None
    minutes: float | None = None  # wall-clock time
    cpu_minutes: float | None = None  # CPU time of all threads of a run
    settings: tuple[str, ...] = ()  # of all configurations; deformation.FIELD only for methods with this field
    even_db: float = 0.1  # dB, PSNR difference from a reference below which two results count as equal
    tables: dict[str, Table] = field(default_factory=dict)  # empty: one of all configurations

    def prepared(self, request: SweepRequest) -> Study:
        """Return the study modified by the request, with resolved `like` references and a table. Raises NeecoError
        naming the invalid field."""
        study = self if request.seeds is None else replace(self, seeds=request.seeds)
        resolved = {name: study.unfolded(name) for name in study.configurations}
        if any(value is not None for value in request.lengths.values()):
            resolved = {name: replace(item, iterations=None) for name, item in resolved.items()}
            study = replace(study, **request.lengths)
        all_rows = {name: TableRow() for name in resolved}
        tables = {
            name: replace(table, title=table.title or name, rows=table.rows or all_rows)
            for name, table in (self.tables or {"results": Table(title=self.title)}).items()
        }
        study = replace(study, configurations=resolved, tables=tables)
        study.check()
        return study

    def check(self) -> None:
        """Raise NeecoError naming the invalid field."""
        if not self.configurations:
            raise NeecoError("configurations: missing; add at least one, with its method")
        for name in self.configurations:
            plain = name.isprintable() and name == name.strip() and not name.startswith(".")
            if not plain or not 0 < len(name.encode()) <= MAX_NAME_BYTES or {*name} & {"/", "\\"}:
                problem = "is not a valid folder name; use a short name without /, \\ and a leading dot"
                raise NeecoError(f"configurations: {name[:40]!r} {problem}")
            self.length_of(name)
        if self.seeds < 1:
            raise NeecoError(f"seeds must be at least 1 (got {self.seeds})")
        for name, table in self.tables.items():
            for row, entry in table.rows.items():
                require_known(f"tables.{name}.rows", row, self.configurations)
                if len(entry.published) > len(table.measures):
                    raise NeecoError(f"tables.{name}.rows.{row}.published: more numbers than measures; remove some")
            for measure in table.measures:
                require_known(f"tables.{name}.measures", measure, MEASURES)
            if table.reference is not None:
                require_known(f"tables.{name}.reference", table.reference, table.rows)

    def unfolded(self, name: str) -> Configuration:
        """Return a configuration with its `like` reference resolved. Raises NeecoError for an unknown name or a
        circular reference."""
        chain = [name]
        while (like := self.configurations[chain[-1]].like) is not None:
            place = f"configurations.{chain[-1]}.like"
            require_known(place, like, self.configurations)
            if like in chain:
                raise NeecoError(f"{place}: circular reference of {like} and {chain[-1]}; give one of them a method")
            chain.append(like)
        items = [self.configurations[each] for each in chain]
        method = next((item.method for item in items if item.method), None)
        if method is None:
            raise NeecoError(f"configurations.{chain[-1]}.method: missing; choose one of `neeco train --help`")
        settings = tuple(setting for item in reversed(items) for setting in item.settings)
        iterations = next((item.iterations for item in items if item.iterations is not None), None)
        return Configuration(method=method, settings=settings, iterations=iterations)

    def length_of(self, name: str) -> tuple[str, float]:
        """Return the length of a configuration's runs: one of LENGTHS, and its value. Raises NeecoError unless there is
        exactly one."""
        iterations = self.configurations[name].iterations
        if iterations is not None:
            return single_length({"iterations": iterations}, f"configurations.{name}.")
        return single_length({key: getattr(self, key) for key in LENGTHS}, "")

    def only(self, tables: Iterable[str]) -> Study:
        """Return the study with these tables and their configurations. Raises NeecoError for an unknown name."""
        for name in tables:
            require_known("--tables", name, self.tables)
        chosen = {name: self.tables[name] for name in tables}
        needed = dict.fromkeys(row for table in chosen.values() for row in table.rows)
        return replace(self, tables=chosen, configurations={name: self.unfolded(name) for name in needed})


def read_study(file: Path) -> Study:
    """Read STUDY.yaml. Raises NeecoError naming the file and the unknown or invalid field."""
    example = "see docs/studies.md for an example"
    values = parse_yaml(file, read_text(file, "a study in YAML"), example)
    if not isinstance(values, dict):
        raise NeecoError(f"{file}: expected a mapping with fields such as configurations; {example}")
    try:
        return structure(Study, values)
    except NeecoError as error:
        raise NeecoError(f"{file}: {error}") from None


def ablations() -> Study:
    """Return the study of `neeco ablate`."""
    return read_study(Path(str(files("neeco.studies") / "ablations.yaml")))


def single_length(lengths: Mapping[str, float | None], place: str) -> tuple[str, float]:
    """Return the one of LENGTHS that has a value, and the value. Raises NeecoError unless there is exactly one and it
    is positive and finite, naming it with the prefix `place`."""
    values = {key: value for key, value in lengths.items() if value is not None}
    if len(values) != 1:
        problem = f"{' and '.join(values)} are given" if values else "the length of the runs is missing"
        raise NeecoError(f"{problem}; give exactly one of {', '.join(LENGTHS)} for all runs (for example --minutes 5)")
    ((key, value),) = values.items()
    if not 0 < value < math.inf:
        field = f"--{key.replace('_', '-')}" if place == "--" else f"{place}{key}:"
        raise NeecoError(f"{field} must be above 0 (got {value})")
    return key, value


def require_known(place: str, name: str, names: Iterable[str]) -> None:
    """Raise NeecoError naming `place` if `name` is not in `names`."""
    if name not in names:
        meant = nearest(name, names)
        hint = "" if meant is None else f"; did you mean {meant}?"
        raise NeecoError(f"{place}: {name!r} is unknown; choose one of: {', '.join(names)}{hint}")
