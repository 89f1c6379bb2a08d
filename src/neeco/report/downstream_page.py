"""The one-page report of a downstream study: whether synthetic images improve a model on recorded frames."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from neeco.capture.model import Capture
from neeco.errors import counted
from neeco.evaluation.mask_metrics import mean_of
from neeco.files import write_text
from neeco.report.charts import PALETTE, Level, Series, inline_svg, legend, line_chart, new_axes, page_style
from neeco.report.downstream_examples import example_sections
from neeco.report.page import REPORT_FILE, split_counts, write_page
from neeco.report.sections import Figure, Section
from neeco.studies.downstream.conditions import PASTE, PERMUTED, REAL
from neeco.studies.downstream.intervals import CONFIDENCE, Scores, arms_of
from neeco.studies.downstream.results import (
    HELPS,
    HURTS,
    MAIN,
    NONE_SHOWN,
    TITLES,
    VERDICTS,
    budget_text,
    curve_table,
    data_files,
    differences_table,
    failed_jobs,
    findings_of,
    main_differences,
    models_and_splits,
    scores_by_fold,
    scores_table,
    summary_text,
    title_of,
    verdict,
)
from neeco.studies.machine import machine_words

FALSE_POSITIVES = round(1 / (1 - CONFIDENCE))  # of so many comparisons without a difference, one shows one
QUESTIONS = {  # what a paired difference answers, as `question` finds it
    "beside": "synthetic images with labelled frames, against the better of these frames alone and augmented",
    "alone": "synthetic images alone, against the better of all labelled frames alone and augmented",
    "control": "labels of other images, against the right ones: they must not help",
    "sets": "one set against another",
    "use": "one way of using a set against the plain one",
    "paste": "cut-and-paste, against the better of labelled frames alone and augmented",
    "augmentation": "strong augmentation against none",
}
HEADLINES = {  # of questions: how the sentence begins
    "beside": "Against the better of the same labelled frames alone and augmented",
    "alone": "Without any label, against the better of all labelled frames alone and augmented",
}
NOTHING_LEARNED = 0.1  # best mean score of any condition below it: less than a guess of all pixels reaches
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
    scored = {split: row["frames"] for job in experiment["jobs"] for split, row in job["splits"].items() if row}
    counts = [f"{scored.get(split, len(capture.split(split)))} frames of {split}" for split in experiment["splits"]]
    intro = (
        f"{models} trained{' from scratch' if from_scratch else ''} on recorded frames that somebody labelled, on "
        f"synthetic images, and on both, always in as many steps; tested on {', '.join(counts)}, recorded, "
        "which no training saw."
    )
    failed = failed_jobs(experiment)
    notes = [note for note in experiment["notes"] if not note.startswith("failed: ")]  # which stand apart
    lists = [Section(title=title, notes=lines) for title, lines in (("What failed", failed), ("Notes", notes)) if lines]
    listings = [
        (f"set {entry['name']}: how it was made", json.dumps(entry["made_by"], indent=1, ensure_ascii=False))
        for entry in experiment["sets"]
        if entry["made_by"]
    ]
    made = Section(title="How it was made", facts=_facts(experiment, capture), listings=listings)
    return write_page(
        output / REPORT_FILE,
        "study.html",
        title=f"{capture.root.name}: what synthetic images are worth",
        name=capture.root.name,
        subtitle="what synthetic images are worth",
        version=experiment["version"],
        stamps=[machine_words(experiment["machine"], "torch_threads")],
        intro=[intro],
        findings=[*(("", line) for line in _headlines(experiment, failed)), *_findings(experiment)],
        sections=[*_results(experiment, files), *images, *_trainings(experiment), *lists, made],
    )


def question(row: Row, experiment: Experiment) -> str:
    """Return the one of QUESTIONS that a paired difference answers."""
    names = {entry["name"] for entry in experiment["sets"]}
    words, others = row["condition"].split("+"), row["against"].split("+")
    synthetic, reference = ([word for word in some if word in names] for some in (words, others))
    if PERMUTED in words:
        return "control"
    if not synthetic:
        return "paste" if PASTE in words else "augmentation"
    if reference:
        return "use" if synthetic == reference else "sets"
    return "beside" if REAL in words else "alone"


def _headlines(experiment: Experiment, failed: Sequence[str]) -> list[str]:
    """Return the headlines: effect of synthetic images with and without labelled frames against these, in the same and
    in other recordings, and what is missing."""
    jobs = experiment["jobs"]
    sentences = [] if experiment["complete"] else ["Not all trainings are finished: these are the numbers so far."]
    verdicts: dict[tuple[str, bool], list[str]] = {}
    for model, split in models_and_splits(experiment):
        for row in main_differences(experiment, model, split):
            verdicts.setdefault((question(row, experiment), split in experiment["tests"]), []).append(verdict(row))
    found = [
        (start, other, counts)
        for asked, start in HEADLINES.items()
        for other in (True, False)
        if (counts := Counter(verdicts.get((asked, other), ())))
    ]
    if not any(asked == "beside" for asked, _ in verdicts):
        sentences.append("No condition has synthetic images with labelled frames to compare with these frames alone.")
    if found and all(set(counts) == {""} for _, _, counts in found):
        sentences.append("One fold: whether synthetic images help cannot be distinguished from chance; give --folds 5.")
        found = []
    for start, other, counts in found:
        verbs = {HELPS: "help", HURTS: "hurt", NONE_SHOWN: "show no difference", "": "have one fold"}
        parts = [f"{verb} in {counts[word]}" for word, verb in verbs.items() if counts[word]]
        kind = {(True, False): "yes", (False, True): "no"}.get((counts[HELPS] > 0, counts[HURTS] > 0), "")
        place = (" in another recording" if other else " in the same recording") if experiment["tests"] else ""
        text = Markup('<b class="{}">{}, synthetic images {} of {} comparisons{}.</b>')
        sentences.append(text.format(kind, start, ", ".join(parts), sum(counts.values()), place))
    for model, split in models_and_splits(experiment):
        metric = MAIN[model["answers"]]
        means = [np.mean(list(folds.values())) for folds in scores_by_fold(jobs, model["name"], split, metric).values()]
        if means and max(means) < NOTHING_LEARNED:
            words = f"{model['name']} learned nothing that {split} shows: its best {TITLES[metric]} is {max(means):.3f}"
            sentences.append(f"{words}. Its differences say nothing; give more --steps, or look at the labels.")
    if failed:
        sentences.append(f"{counted(len(failed), 'training')} failed; they are listed below.")
    return sentences


def _findings(experiment: Experiment) -> list[tuple[str, Markup]]:
    """(model and split, sentence) of all that the numbers say, verdicts in their colours."""
    found = []
    for model, split in models_and_splits(experiment):
        for sentence in findings_of(experiment, model, split):
            text = escape(sentence)
            for word in VERDICTS:
                kind = {HELPS: "yes", HURTS: "no"}.get(word, "soft")
                colored = Markup('; <b class="{}">{}</b> against').format(kind, word)
                text = text.replace(Markup(f"; {word} against"), colored)
            found.append((f"{model['name']}, {split}", text))
    return found


def _family(condition: str) -> str:
    """Return the family of a condition: a set alone and with labelled frames share one, and a colour."""
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


def _results(experiment: Experiment, files: Mapping[str, str]) -> list[Section]:
    """For every model and split its scores, as a table and over labelled frames, and their differences."""
    known = families(experiment)
    key = legend(known, known)
    sections, known_scores = [], Scores(experiment["jobs"])
    for model in experiment["models"]:
        charts = [score_chart(experiment, model, split, known_scores) for split in experiment["splits"]]
        if figures := [Figure(chart, key) for chart in charts if chart]:
            title = f"{model['name']}: {TITLES[MAIN[model['answers']]]} by labelled frames"
            sections.append(Section(title=title, level=3, figures=figures))
    for model, split in models_and_splits(experiment):
        for make in (curve_table, differences_table, scores_table):
            if (table := make(experiment, model, split)).rows:
                chart = make is differences_table
                figures = [Figure(difference_chart(experiment, model, split), [])] if chart else []
                sections.append(Section(title=table.title, split=split, level=3, results=table, figures=figures))
    text = (
        "Curves: the mean over folds with its interval; dashed from side to side a set alone, without any labelled "
        "frame; with labelled frames it has the same colour. Intervals hold the mean, or the difference on the same "
        f"folds and frames, with {CONFIDENCE:.0%} confidence: a bootstrap over seeds and blocks of neighbouring "
        "frames. A difference whose interval reaches 0 shows none, green is better than its reference, red is worse. "
        f"Of {FALSE_POSITIVES} comparisons that differ in nothing about one is called a difference all the same."
    )
    listed = ("summary.csv", "scores.csv", "paired.csv", "jobs.csv")  # data/frames.csv would outweigh the page
    return [Section(title="Results", text=text, files={name: files[name] for name in listed}), *sections]


def score_chart(experiment: Experiment, model: Row, split: str, scores: Scores) -> str:
    """The main score over the number of labelled frames, with its intervals; sets alone are levels. The legend names
    the lines: on a narrow page their names would take its width."""
    metric = MAIN[model["answers"]]
    lines: dict[str, list[tuple[float, float, float, float]]] = {}
    levels = []
    for arm in sorted(scores.jobs, key=lambda arm: (_order(arm.condition, experiment), arm.real)):
        if arm.model != model["name"] or (mean := scores.mean(arm, split, metric)) is None:
            continue
        if REAL not in arm.words:
            levels.append(Level("", _order(arm.condition, experiment), mean))
            continue
        ends = scores.interval(arm, split, metric)
        low, high = (mean if end is None else end for end in ends)
        lines.setdefault(arm.condition, []).append((float(arm.real), mean, low, high))
    series = []
    for condition, points in lines.items():
        main = tuple((count, mean) for count, mean, _, _ in points)
        band = tuple((count, low, high) for count, _, low, high in points)
        series.append(Series("", _order(condition, experiment), main, dots=main, band=band))
    title = f"{TITLES[metric]}: {model['name']}, {split}"
    return line_chart(title, "labelled frames", series, levels=levels, over_logarithmic=True)


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
    axes.locator_params(axis="x", nbins=5)
    axes.set_xlabel(f"difference of {TITLES[MAIN[model['answers']]]}")
    for y, (key, row) in enumerate(lines):
        name, color = QUESTIONS[key], "accent"
        if row is not None:
            reference = f" − {row['against']}" if key in ("sets", "use") else ""
            name = (title_of(row["condition"], row["real"]) + reference)[:45]
            color = {HELPS: "good", HURTS: "bad"}.get(verdict(row), "soft")
            shade = PALETTE[color]
            axes.plot([0, 0], [y - 0.5, y + 0.5], color=PALETTE["edge"], linewidth=1)
            if row["low"] is not None:
                low, high = np.clip([row["low"], row["high"]], -reach, reach)
                axes.plot([low, high], [y, y], color=shade, linewidth=2)
                axes.plot(low, y, color=shade, marker="|" if low == row["low"] else "<", markersize=7)
                axes.plot(high, y, color=shade, marker="|" if high == row["high"] else ">", markersize=7)
            axes.plot(row["difference"], y, color=shade, marker="o", markersize=6)
        place = axes.get_yaxis_transform()
        axes.annotate(name, (0, y), (-290, 0), place, "offset points", va="center", color=PALETTE[color])
    return inline_svg(axes, f"differences of {model['name']} on {split}")


def _trainings(experiment: Experiment) -> list[Section]:
    """Return the section on training: a line per arm, means over folds."""
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
                *(f"{mean_of([job[key] for job in same]):,.0f}" for key in ("seconds", "processor_seconds")),
            ]
        )
    if not rows:
        return []
    head = ["model, trained on", "labelled frames", "steps", "input", "batch", "s", "CPU s"]
    text = f"{budget_text(experiment)}. The weights after the last step are tested."
    return [Section(title="Training", text=text, head=head, rows=rows)]


def _facts(experiment: Experiment, capture: Capture) -> list[tuple[str, str]]:
    machine, given = experiment["machine"], experiment["teaching"]
    labels = given["labels"] or "the capture's truth"
    chosen = "spread over the recording, others in every fold" if given["pick"] == "spread" else "the first of it"
    labelled = f"of {experiment['labelled']:,}, {chosen}; labels: {labels}" if experiment["labelled"] else "none"
    return [
        ("command", experiment["command"]),
        ("capture", experiment["capture"]),
        ("frames", split_counts(capture)),
        ("labelled frames", labelled),
        *((f"other recording {name}", path) for name, path in experiment["tests"].items()),
        *((f"set {entry['name']}", _set_words(entry)) for entry in experiment["sets"]),
        ("classes", ", ".join(experiment["classes"])),
        ("machine", machine_words(machine, "torch_threads")),
        ("versions", f"neeco {experiment['version']}, Python {machine['python']}, torch {machine['torch']}"),
    ]


def _set_words(entry: Row) -> str:
    """Return the size and source of a set, in words."""
    images, made = f"{entry['images']:,} images of {entry['path']}", entry["made_by"]
    if made is None:
        return f"{images}; how they were made is not known: it has no dataset.json"
    scene = f", synthesized from {made['scene']}" if made["scene"] else ""
    return f"{images}{scene}; dataset.json sha256 {entry['sha256'][:12]}"
