"""Figures of a downstream experiment: scores over labelled frames, differences with intervals, training courses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from neeco.evaluation.mask_metrics import mean_of
from neeco.experiments.downstream.job import AUGMENT, REAL
from neeco.experiments.downstream.results import HELPS, HURTS, MAIN, TITLES, title_of, verdict
from neeco.report.charts import (
    PALETTE,
    Level,
    Point,
    Series,
    inline_svg,
    legend,
    line_chart,
    new_axes,
    page_style,
    short,
)

COURSE = (340, 210)  # view box units
BAR, SCALE = (150, 16), (150, 14)  # view box units of an interval and of the scale above all
BAR_EDGE = 8  # units at each side that a bar leaves free
ROUND = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)  # first digits of what a scale ends with
REACH = 3.0  # times the largest difference: what an interval shows at most, for folds so few that it says nothing
GROUPS = (  # key of what is asked, as `question` finds it, and its words
    ("beside", "drawn images beside labelled frames, against the same frames alone"),
    ("augmented", "drawn images beside labelled frames, against these frames with classical augmentation"),
    ("alone", "drawn images alone, against the most labelled frames alone"),
    ("sets", "one set against another"),
    ("use", "one way of using a set against the plain one"),
    ("augmentation", "classical augmentation against none"),
)

Experiment = Mapping[str, Any]


@dataclass(frozen=True)
class Difference:
    """A line of the table of differences."""

    first: str
    second: str
    difference: str
    interval: str
    folds: int
    verdict: str  # one of VERDICTS, or "" of a single fold
    bar: str


@dataclass(frozen=True)
class Differences:
    """The differences of one model and split, by what they answer."""

    model: str
    split: str
    title: str  # of the score
    groups: tuple[tuple[str, str, tuple[Difference, ...]], ...]  # what is asked, the scale of its bars, its lines


def sets_in(condition: str, experiment: Experiment) -> list[str]:
    """The sets among a condition's words."""
    names = [entry["name"] for entry in experiment["sets"]]
    return [word for word in condition.split("+") if word in names]


def with_labelled(condition: str) -> bool:
    """Whether labelled frames are among what a condition teaches with."""
    return REAL in condition.split("+")


def families(experiment: Experiment) -> list[str]:
    """Conditions in their order, a set alone and beside labelled frames under one name: they share a colour."""
    found: dict[str, str] = {}
    for condition in dict.fromkeys(job["condition"] for job in experiment["jobs"]):
        key = _family(condition)
        found[key] = condition if key not in found or with_labelled(condition) else found[key]
    return list(found.values())


def _family(condition: str) -> str:
    return "+".join(sorted(word for word in condition.split("+") if word != REAL))


def _order(condition: str, known: Sequence[str]) -> int:
    return [_family(name) for name in known].index(_family(condition))


def score_chart(experiment: Experiment, model: Mapping[str, Any], split: str) -> str:
    """The main score over the number of labelled frames; sets alone are levels."""
    metric, known = MAIN[model["answers"]], families(experiment)
    jobs = [job for job in experiment["jobs"] if job["model"] == model["name"] and "error" not in job]
    values: dict[str, dict[int, dict[int, float]]] = {}  # condition -> labelled frames -> fold -> score
    for job in jobs:
        value = job["splits"].get(split, {}).get(metric)
        if value is not None:
            values.setdefault(job["condition"], {}).setdefault(job["real"], {})[job["fold"]] = value
    series, levels = [], []
    for condition in sorted(values, key=lambda name: _order(name, known)):
        counts, order = values[condition], _order(condition, known)
        means = tuple((float(count), mean_of(list(counts[count].values()))) for count in sorted(counts))
        if with_labelled(condition):
            series.append(Series(condition, order, means, _lines_of_folds(counts), means))
        else:
            levels.append(Level(condition, order, means[0][1]))
    title = f"{TITLES[metric]}: {model['name']}, {split}"
    return line_chart(title, "labelled frames", series, levels=levels, over_logarithmic=True)


def line_key(experiment: Experiment, alone: bool = False) -> list[tuple[str, Markup]]:
    """The lines of the charts by the conditions they stand for. alone: also of sets that never stand beside labelled
    frames."""
    known = families(experiment)
    return legend(known, [name for name in known if alone or with_labelled(name)])


def _lines_of_folds(counts: Mapping[int, Mapping[int, float]]) -> tuple[tuple[Point, ...], ...]:
    """A line per fold over the counts it has; none where there is one fold, whose line is the mean's."""
    folds = sorted({fold for scores in counts.values() for fold in scores})
    lines = [
        tuple((float(count), counts[count][fold]) for count in sorted(counts) if fold in counts[count])
        for fold in folds
    ]
    return tuple(line for line in lines if len(line) > 1) if len(folds) > 1 else ()


def course_charts(experiment: Experiment, model: Mapping[str, Any]) -> list[str]:
    """Validation score over steps, a chart per number of labelled frames; of the first fold that finished."""
    known, charts = families(experiment), []
    done = [job for job in experiment["jobs"] if job["model"] == model["name"] and "error" not in job]
    for real in sorted({job["real"] for job in done}):
        first: dict[str, Mapping[str, Any]] = {}
        for job in sorted(done, key=lambda job: job["fold"]):
            if job["real"] == real:
                first.setdefault(job["condition"], job)
        series = [
            Series("", _order(name, known), tuple((float(step), score) for step, score in job["validation"]))
            for name, job in sorted(first.items(), key=lambda entry: _order(entry[0], known))
            if job["validation"]
        ]
        taught = f"{real:,} labelled" if real else "sets alone"
        charts.append(line_chart(f"{model['name']}, {taught}", "steps", series, size=COURSE))
    return [chart for chart in charts if chart]


def question(row: Mapping[str, Any], experiment: Experiment) -> str:
    """Which of GROUPS a paired difference belongs to."""
    drawn, other = sets_in(row["condition"], experiment), sets_in(row["against"], experiment)
    if not drawn:
        return "augmentation"
    if other:
        return "use" if drawn == other else "sets"
    if not with_labelled(row["condition"]):
        return "alone"
    return "augmented" if AUGMENT in row["against"].split("+") else "beside"


@page_style()
def differences(experiment: Experiment, model: Mapping[str, Any], split: str) -> Differences | None:
    """The paired differences of the main score; None where there are none."""
    metric = MAIN[model["answers"]]
    wanted = (model["name"], split, metric)
    rows = [row for row in experiment["paired"] if (row["model"], row["split"], row["metric"]) == wanted]
    if not rows:
        return None
    groups = []
    for key, words in GROUPS:
        among = [row for row in rows if question(row, experiment) == key]
        if among:
            span = _span(among)
            groups.append((words, _scale(span), tuple(_difference(row, span) for row in among)))
    return Differences(model["name"], split, TITLES[metric], tuple(groups))


def _span(rows: Sequence[Mapping[str, Any]]) -> float:
    """A round number that bars of these rows reach to, at each side of 0."""
    largest = max(abs(row["difference"]) for row in rows)
    ends = [abs(row[end]) for row in rows for end in ("low", "high") if row[end] is not None]
    wanted = min(max([largest, *ends]), REACH * largest)
    if wanted <= 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(wanted))
    return float(next(step * decade for step in ROUND if step * decade >= wanted * (1 - 1e-9)))


def _difference(row: Mapping[str, Any], span: float) -> Difference:
    known = row["low"] is not None
    return Difference(
        title_of(row["condition"], row["real"]),
        title_of(row["against"], row["against_real"]),
        signed(row["difference"]),
        f"{signed(row['low'])} to {signed(row['high'])}" if known else "–",
        row["folds"],
        verdict(row),
        _bar(row, span),
    )


def signed(value: float) -> str:
    """A difference with its sign, a true minus; none of what rounds to 0."""
    return f"{value:+.3f}".replace("-", "−") if round(value, 3) else "0.000"


def _bar(row: Mapping[str, Any], span: float) -> Markup:
    """The interval about its difference; an arrow where it goes on beyond the scale."""
    axes = new_axes(BAR, BAR_EDGE, BAR_EDGE, 0, 0)
    axes.set(xlim=(-span, span), ylim=(-1, 1))
    axes.set_axis_off()
    axes.axvline(0, color=PALETTE["soft"], linewidth=1)
    color = PALETTE[{HELPS: "good", HURTS: "bad"}.get(verdict(row), "soft")]
    style: dict[str, Any] = {"color": color, "clip_on": False, "linestyle": ""}
    if row["low"] is not None:
        low, high = max(row["low"], -span), min(row["high"], span)
        axes.plot([low, high], [0, 0], color=color, linewidth=2, clip_on=False)
        for end, shown, arrow in ((row["low"], low, "<"), (row["high"], high, ">")):
            cut = end != shown
            axes.plot(shown, 0, marker=arrow if cut else "|", markersize=6 if cut else 9, **style)
    axes.plot(row["difference"], 0, marker="o", markersize=7, markeredgewidth=0, **style)
    words = verdict(row) or "no interval"
    return inline_svg(axes, f"difference {signed(row['difference'])}, {words}")


def _scale(span: float) -> Markup:
    """The numbers that bars reach to."""
    axes = new_axes(SCALE, BAR_EDGE, BAR_EDGE, 0, 0)
    axes.set(xlim=(-span, span), ylim=(0, 1))
    axes.set_axis_off()
    for place, align in ((-span, "left"), (0.0, "center"), (span, "right")):
        words = "0" if not place else f"{'−' if place < 0 else '+'}{short(abs(place))}"
        moved = BAR_EDGE * span / (BAR[0] / 2 - BAR_EDGE) * ((place > 0) - (place < 0))
        axes.text(place + moved, 0.2, words, ha=align, color=PALETTE["soft"])
    return inline_svg(axes, "scale of the differences")
