"""The one-page report of a downstream study: do synthetic images teach a model what recorded frames ask of it?"""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes

from neeco.capture.model import Capture
from neeco.evaluation.mask_metrics import mean_of
from neeco.experiments.downstream.job import AUGMENT, REAL, default_conditions
from neeco.experiments.downstream.results import (
    CONFIDENCE,
    HELPS,
    HURTS,
    MAIN,
    TITLES,
    VERDICTS,
    arms_of,
    budget_text,
    data_files,
    differences_table,
    equivalent,
    failed_jobs,
    findings_of,
    main_differences,
    models_and_splits,
    real_curve,
    scores_by_fold,
    scores_table,
    summary_text,
    title_of,
    verdict,
)
from neeco.experiments.machine import machine_words
from neeco.files import write_text
from neeco.report.charts import PALETTE, Level, Series, inline_svg, legend, line_chart, new_axes, page_style
from neeco.report.downstream_examples import example_sections
from neeco.report.page import REPORT_FILE, split_counts, write_page
from neeco.report.study_pages import Figure, Section

FALSE_POSITIVES = round(1 / (1 - CONFIDENCE))  # of so many comparisons without a difference, one shows one
QUESTIONS = {  # what a paired difference answers, as `question` finds it
    "beside": "synthetic images beside labelled frames, against these frames alone",
    "augmented": "the same, against these frames with classical augmentation",
    "alone": "synthetic images alone, against the most labelled frames alone",
    "sets": "one set against another",
    "use": "one way of using a set against the plain one",
    "augmentation": "classical augmentation against none",
}
MAX_REACH = 3.0  # times the largest difference that an interval is shown to: those of two folds would hide the rest

Experiment = Mapping[str, Any]
Row = Mapping[str, Any]


def write_downstream_report(output: Path, experiment: Experiment, capture: Capture) -> Path:
    """Write `report.html` and `data/*.csv` into `output`, the folder of a downstream study, and return the page's path.

    experiment: what `run_downstream` returned; predictions are read from `output`. Raises NeecoError when a picture
    cannot be read or the page not be written.
    """
    images, examples = example_sections(experiment, capture, output)
    files = {"summary.csv": summary_text(experiment), "examples.csv": examples, **data_files(experiment)}
    for name, text in files.items():
        write_text(output / "data" / name, text)
    models = " and ".join(model["name"] for model in experiment["models"])
    from_scratch = not any(model["weights"] for model in experiment["models"])
    intro = (
        f"{models} trained{' from scratch' if from_scratch else ''} on recorded frames that somebody labelled, on "
        f"synthetic images, and on both, always in as many steps; tested on {_tested(experiment, capture)}, recorded, "
        "which no training saw."
    )
    failed, notes = failed_jobs(experiment), experiment["notes"]
    sections = [
        *_glance(experiment),
        *_findings(experiment),
        *_score_curves(experiment, files),
        *_differences(experiment, files),
        *_numbers(experiment, files),
        *images,
        *_trainings(experiment, files),
        Section(title="What failed", notes=failed),
        Section(title="Notes", notes=[note for note in notes if not note.startswith("failed: ")]),  # shown above
        Section(title="How it was made", facts=_facts(experiment, capture), listings=_set_listings(experiment)),
    ]
    return write_page(
        output / REPORT_FILE,
        "study.html",
        title=f"{capture.root.name}: what synthetic images are worth",
        name=capture.root.name,
        subtitle="what synthetic images are worth",
        version=experiment["version"],
        stamps=[machine_words(experiment["machine"], "torch_threads")],
        intro=[intro],
        findings=[("", sentence) for sentence in _headlines(experiment, failed)],
        sections=[section for section in sections if section.title not in ("What failed", "Notes") or section.notes],
    )


def question(row: Row, experiment: Experiment) -> str:
    """Which of QUESTIONS a paired difference answers."""
    names = {entry["name"] for entry in experiment["sets"]}
    words, others = row["condition"].split("+"), row["against"].split("+")
    synthetic, reference = ([word for word in some if word in names] for some in (words, others))
    if not synthetic:
        return "augmentation"
    if reference:
        return "use" if synthetic == reference else "sets"
    if REAL not in words:
        return "alone"
    return "augmented" if AUGMENT in others else "beside"


def _beside(experiment: Experiment) -> list[Row]:
    """The differences that the study is about: synthetic images beside labelled frames against these alone."""
    rows = [row for pair in models_and_splits(experiment) for row in main_differences(experiment, *pair)]
    return [row for row in rows if question(row, experiment) == "beside"]


def _colored(word: str) -> Markup:
    """A verdict in its colour."""
    return Markup('<span class="{}">{}</span>').format({HELPS: "yes", HURTS: "no"}.get(word, "soft"), word)


def _headlines(experiment: Experiment, failed: Sequence[str]) -> list[str]:
    """What all differences together say, in a sentence, and what is missing."""
    sentences = []
    if not experiment["complete"]:
        sentences.append("Not all trainings are finished: these are the numbers so far.")
    counts = Counter(verdict(row) for row in _beside(experiment))
    if not counts:
        sentences.append("No condition has synthetic images beside labelled frames to compare with these frames alone.")
    elif set(counts) == {""}:
        sentences.append("One fold: whether synthetic images help cannot be told from chance; give --folds 5.")
    else:
        verbs = dict(zip(VERDICTS, ("help", "hurt", "show no difference"), strict=True))
        parts = [Markup("{} in {}").format(verbs[word], counts[word]) for word in VERDICTS if counts[word]]
        sentence = f"{', '.join(parts)} of {sum(counts.values())} comparisons."
        kind = {(True, False): "yes", (False, True): "no"}.get((counts[HELPS] > 0, counts[HURTS] > 0), "")
        lead = "Beside the same labelled frames, synthetic images"
        sentences.append(Markup('<b class="{}">{} {}</b>').format(kind, lead, sentence))
    if failed:
        sentences.append(f"{len(failed)} training{'s' if len(failed) > 1 else ''} failed; they are listed below.")
    return sentences


def _glance(experiment: Experiment) -> list[Section]:
    """Whether synthetic images beside labelled frames help: a line per model, split and condition, a cell per count."""
    rows = _beside(experiment)
    counts = sorted({row["real"] for row in rows})
    lines: dict[tuple[str, str, str], dict[int, Markup]] = {}
    for row in rows:
        word, as_many = verdict(row), _as_many(row, experiment)
        parts = [escape(signed(row["difference"])), _colored(word), Markup("<small>{}</small>").format(as_many)]
        shown = [part for part, text in zip(parts, ("difference", word, as_many), strict=True) if text]
        line = lines.setdefault((row["condition"], row["model"], row["split"]), {})
        line[row["real"]] = Markup("<br>").join(shown)
    if not lines:
        return []
    text = (
        "What synthetic images add to the score of the same labelled frames alone, mean over folds. “As good as about "
        "50”: as 50 labelled frames alone, read between the numbers tried."
    )
    if any(verdict(row) for row in rows):
        text += (
            " “Helps” and “hurts”: the 95 % interval of the difference leaves out 0. Of "
            f"{FALSE_POSITIVES} comparisons that differ in nothing about one is called so all the same."
        )
    table = [
        [Markup("<b>{}</b><br><small>{}, {}</small>").format(*key), *(cells.get(count, "–") for count in counts)]
        for key, cells in lines.items()
    ]
    head = ["trained on", *(f"{count:,} labelled" for count in counts)]
    return [Section(title="At a glance", text=text, head=head, rows=table)]


def _as_many(row: Row, experiment: Experiment) -> str:
    """`as good as about 55`: how many labelled frames alone do as well as the first of a difference, over the folds
    that all of these finished; "" where that cannot be read: of one number of frames only, or scores all 0."""
    scores = scores_by_fold(experiment["jobs"], row["model"], row["split"], row["metric"])
    key = row["condition"], row["real"]
    curve = real_curve(scores, key)
    if len(curve) < 2 or not any(score for _, score in curve):
        return ""
    return equivalent(curve, mean_of(list(scores[key].values())))


def _findings(experiment: Experiment) -> list[Section]:
    """The sentences of each model and split, verdicts in their colours."""
    sections = []
    for model, split in models_and_splits(experiment):
        notes = []
        for sentence in findings_of(experiment, model, split):
            text = escape(sentence)
            for word in VERDICTS:
                text = text.replace(Markup(f"; {word} against"), Markup("; <b>{}</b> against").format(_colored(word)))
            notes.append(text)
        if notes:
            sections.append(Section(title=f"{model['name']}, {split}", split=split, level=3, notes=notes))
    return [Section(title="In words"), *sections] if sections else []


def _family(condition: str) -> str:
    """A set alone and beside labelled frames are of one family, and share a colour."""
    return "+".join(sorted(word for word in condition.split("+") if word != REAL))


def families(experiment: Experiment) -> list[str]:
    """A condition of each family, in their order: the one with labelled frames where there is one."""
    found: dict[str, str] = {}
    for condition in dict.fromkeys(job["condition"] for job in experiment["jobs"]):
        key = _family(condition)
        found[key] = condition if key not in found or REAL in condition.split("+") else found[key]
    return list(found.values())


def _order(condition: str, experiment: Experiment) -> int:
    return [_family(name) for name in families(experiment)].index(_family(condition))


def _score_curves(experiment: Experiment, files: Mapping[str, str]) -> list[Section]:
    known = families(experiment)
    key = legend(known, [name for name in known if REAL in name.split("+")])
    charts = [score_chart(experiment, model, split) for model, split in models_and_splits(experiment)]
    text = (
        "Bold: mean over folds; thin: each fold. Dashed from side to side: a set alone, without any labelled frame, in "
        "the colour it has beside labelled frames."
    )
    figures = [Figure(chart, key) for chart in charts if chart]
    listed = {name: files[name] for name in ("scores.csv", "summary.csv")}
    return [Section(title="Score over labelled frames", text=text, figures=figures, files=listed)] if figures else []


def score_chart(experiment: Experiment, model: Row, split: str) -> str:
    """The main score over the number of labelled frames; sets alone are levels."""
    metric = MAIN[model["answers"]]
    scores = scores_by_fold(experiment["jobs"], model["name"], split, metric)
    series, levels = [], []
    for condition in sorted(dict.fromkeys(name for name, _ in scores), key=lambda name: _order(name, experiment)):
        counts = {float(real): folds for (name, real), folds in sorted(scores.items()) if name == condition}
        means = tuple((count, mean_of(list(folds.values()))) for count, folds in counts.items())
        order = _order(condition, experiment)
        if REAL not in condition.split("+"):
            levels.append(Level(condition, order, means[0][1]))
            continue
        numbers = sorted({fold for folds in counts.values() for fold in folds})
        lines = [tuple((count, folds[fold]) for count, folds in counts.items() if fold in folds) for fold in numbers]
        faint = tuple(line for line in lines if len(line) > 1) if len(lines) > 1 else ()
        series.append(Series(condition, order, means, faint, means))
    title = f"{TITLES[metric]}: {model['name']}, {split}"
    return line_chart(title, "labelled frames", series, levels=levels, over_logarithmic=True)


def _differences(experiment: Experiment, files: Mapping[str, str]) -> list[Section]:
    sections = []
    for model, split in models_and_splits(experiment):
        rows, table = main_differences(experiment, model, split), differences_table(experiment, model, split)
        if rows:
            name, chart = f"{model['name']}, {split}", difference_chart(experiment, model, split)
            sections.append(Section(title=name, split=split, level=3, results=table, figures=[Figure(chart, [])]))
    text = (
        "Of the same folds, with the interval in which the mean lies with 95 % (Student's t over folds). An interval "
        "that reaches 0 shows no difference; green is better than its reference, red is worse."
    )
    listed = {"paired.csv": files["paired.csv"]}
    return [Section(title="Differences", text=text, files=listed), *sections] if sections else []


@page_style()
def difference_chart(experiment: Experiment, model: Row, split: str) -> Markup:
    """Every paired difference with its interval, by the question it answers; arrows where an interval goes on."""
    rows = main_differences(experiment, model, split)
    ends = [abs(row[end]) for row in rows for end in ("difference", "low", "high") if row[end] is not None]
    reach = min(max(ends), MAX_REACH * max(abs(row["difference"]) for row in rows)) or 1.0
    groups = {key: [row for row in rows if question(row, experiment) == key] for key in QUESTIONS}
    lines = [(key, row) for key, some in groups.items() if some for row in (None, *some)]
    axes = new_axes((560, 45 + 20 * len(lines)), 300, 20, 5, 40)
    axes.set(xlim=(-reach, reach), ylim=(len(lines) - 0.5, -0.5), yticks=[])
    axes.set_xlabel(f"difference of {TITLES[MAIN[model['answers']]]}")
    for y, (key, row) in enumerate(lines):
        name, color = QUESTIONS[key], "accent"
        if row is not None:
            reference = f" − {row['against']}" if key in ("sets", "use") else ""
            name = (title_of(row["condition"], row["real"]) + reference)[:45]
            color = {HELPS: "good", HURTS: "bad"}.get(verdict(row), "soft")
            _draw_interval(axes, y, row, reach, PALETTE[color])
        place = axes.get_yaxis_transform()
        axes.annotate(name, (0, y), (-290, 0), place, "offset points", va="center", color=PALETTE[color])
    return inline_svg(axes, f"differences of {model['name']} on {split}")


def _draw_interval(axes: Axes, y: float, row: Row, reach: float, color: str) -> None:
    axes.plot([0, 0], [y - 0.5, y + 0.5], color=PALETTE["edge"], linewidth=1)
    if row["low"] is not None:
        low, high = np.clip([row["low"], row["high"]], -reach, reach)
        axes.plot([low, high], [y, y], color=color, linewidth=2)
        axes.plot(low, y, color=color, marker="|" if low == row["low"] else "<", markersize=7)
        axes.plot(high, y, color=color, marker="|" if high == row["high"] else ">", markersize=7)
    axes.plot(row["difference"], y, color=color, marker="o", markersize=6)


def signed(value: float) -> str:
    """A difference with its sign, a true minus; none of what rounds to 0."""
    return f"{value:+.3f}".replace("-", "−") if round(value, 3) else "0.000"


def _numbers(experiment: Experiment, files: Mapping[str, str]) -> list[Section]:
    tables = [(split, scores_table(experiment, model, split)) for model, split in models_and_splits(experiment)]
    sections = [
        Section(title=table.title, split=split, level=3, results=table) for split, table in tables if table.rows
    ]
    listed = {name: files[name] for name in ("jobs.csv", "frames.csv")}
    text = "Mean ± standard deviation over folds; the best is bold."
    return [Section(title="Numbers", text=text, files=listed), *sections] if sections else []


def _trainings(experiment: Experiment, files: Mapping[str, str]) -> list[Section]:
    """How trainings went: validation curves, and a line per arm, means over folds."""
    done = [job for job in experiment["jobs"] if "error" not in job]
    rows = []
    for arm in arms_of(done):
        same = [job for job in done if (job["model"], job["condition"], job["real"]) == arm]
        width, height = same[0]["input"]
        rows.append(
            [
                f"{arm.model}, {arm.condition}",
                f"{arm.real:,}" if arm.real else "none",
                f"{same[0]['iterations']:,}",
                f"{width}x{height}",
                str(same[0]["batch"]),
                f"{mean_of([job['best_step'] for job in same]):,.0f}",
                f"{sum(job['still_learning'] for job in same)} of {len(same)}",
                *(f"{mean_of([job[key] for job in same]):,.0f}" for key in ("seconds", "processor_seconds")),
            ]
        )
    if not rows:
        return []
    head = [
        "model, trained on",
        "labelled frames",
        "steps",
        "input",
        "batch",
        "best step",
        "still rising",
        "s",
        "CPU s",
    ]
    charts = [chart for model in experiment["models"] for chart in validation_charts(experiment, model)]
    text = (
        f"{budget_text(experiment)}. Each keeps the weights that scored best on held-out images, one in "
        f"{experiment['held_back_every']} of what it learns from; where none can be held out, the last."
    )
    if charts:
        text += (
            " The curves are scores on these images over steps, of the first fold. The images differ between "
            "conditions: read a curve by its shape. A set alone has the colour that it has beside labelled frames."
        )
    key = legend(families(experiment), families(experiment))
    figures = [Figure(chart, key) for chart in charts]
    listed = {"validation.csv": files["validation.csv"]}
    return [Section(title="Training", text=text, head=head, rows=rows, figures=figures, files=listed)]


def validation_charts(experiment: Experiment, model: Row) -> list[str]:
    """Validation score over steps, a chart per number of labelled frames; of the first fold that finished."""
    done = [job for job in experiment["jobs"] if job["model"] == model["name"] and "error" not in job]
    charts = []
    for real in sorted({job["real"] for job in done}):
        first: dict[str, Row] = {}
        for job in sorted(done, key=lambda job: job["fold"]):
            if job["real"] == real:
                first.setdefault(job["condition"], job)
        series = [
            Series("", _order(name, experiment), tuple((float(step), score) for step, score in job["validation"]))
            for name, job in sorted(first.items(), key=lambda entry: _order(entry[0], experiment))
            if job["validation"]
        ]
        title = f"{model['name']}, {f'{real:,} labelled' if real else 'sets alone'}"
        charts.append(line_chart(title, "steps", series, size=(340, 210)))
    return [chart for chart in charts if chart]


def _tested(experiment: Experiment, capture: Capture) -> str:
    """`12 frames of test and 8 of unseen`."""
    scored = {split: row["frames"] for job in experiment["jobs"] for split, row in job["splits"].items() if row}
    counts = [f"{scored.get(split, len(capture.split(split)))} frames of {split}" for split in experiment["splits"]]
    return " and ".join(counts)


def command_of(experiment: Experiment) -> str:
    """The command that makes this study."""
    given, jobs = experiment["teaching"], experiment["jobs"]
    counts = sorted({job["real"] for job in jobs})
    conditions = list(dict.fromkeys(job["condition"] for job in jobs))
    usual = {
        name
        for name in default_conditions([entry["name"] for entry in given["sets"]])
        if any(bool(count) == (REAL in name.split("+")) for count in counts)
    }
    limit = {entry["name"]: "" if entry["count"] is None else f":{entry['count']}" for entry in given["sets"]}
    options: dict[str, Sequence[Any]] = {
        "sets": [f"{entry['name']}={entry['path']}{limit[entry['name']]}" for entry in given["sets"]],
        "models": [model["name"] for model in experiment["models"]],
        "num-real": ["all" if count and count == experiment["labelled"] else count for count in counts],
        "folds": [experiment["folds"]],
        "conditions": [] if set(conditions) == usual else conditions,
        "labels": [given["labels"]],
        "classes": [given["classes"]] if given["classes"] != "instrument" else [],
        "frame-selection": [given["pick"]] if given["pick"] != "spread" else [],
        "splits": experiment["splits"],
        "steps": [given["steps"]],
        "size": [given["side"]],
        "batch": [given["batch"]],
        "weights": [f"{model['name']}={model['weights']}" for model in experiment["models"] if model["weights"]],
        "transforms": [given["transforms"]] if given["transforms"] != "transforms.json" else [],
        "device": [given["device"]] if given["device"] != "auto" else [],
    }
    words = ["neeco", "downstream", experiment["capture"]]
    for option, values in options.items():
        known = [str(value) for value in values if value is not None]
        words += [word for value in known for word in (f"--{option}", value)] if option == "weights" else []
        words += [f"--{option}", *known] if known and option != "weights" else []
    return shlex.join([*words, "--output", "DIR"])


def _facts(experiment: Experiment, capture: Capture) -> list[tuple[str, str]]:
    machine, given = experiment["machine"], experiment["teaching"]
    labels = given["labels"] or "the capture's truth"
    chosen = "spread over the recording, others in every fold" if given["pick"] == "spread" else "the first of it"
    labelled = f"of {experiment['labelled']:,}, {chosen}; labels: {labels}" if experiment["labelled"] else "none"
    return [
        ("command", command_of(experiment)),
        ("capture", experiment["capture"]),
        ("frames", split_counts(capture)),
        ("labelled frames", labelled),
        *((f"set {entry['name']}", _set_words(entry)) for entry in experiment["sets"]),
        ("classes", ", ".join(experiment["classes"])),
        ("budget", budget_text(experiment)),
        ("machine", machine_words(machine, "torch_threads")),
        ("versions", f"neeco {experiment['version']}, Python {machine['python']}, torch {machine['torch']}"),
    ]


def _set_words(entry: Row) -> str:
    """How many images of where, and how they were synthesized."""
    images, made = f"{entry['images']:,} images of {entry['path']}", entry["made_by"]
    if made is None:
        return f"{images}; how they were made is not known: it has no dataset.json"
    scene = f", synthesized from {made['scene']}" if made["scene"] else ""
    settings = made["settings"] or {}
    known = [f"{key} {settings[key]}" for key in ("states", "views", "labels", "seed") if settings.get(key) is not None]
    how = f" ({', '.join(known)})" if known else ""
    return f"{images}{scene}{how}; dataset.json sha256 {entry['sha256'][:12]}"


def _set_listings(experiment: Experiment) -> list[tuple[str, str]]:
    return [
        (f"set {entry['name']}: how it was made", json.dumps(entry["made_by"], indent=1, ensure_ascii=False))
        for entry in experiment["sets"]
        if entry["made_by"]
    ]
