"""The one-page report of a downstream experiment: do drawn images teach what recorded frames ask?"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neeco.capture.model import Capture
from neeco.evaluation.image_metrics import PART_COLORS
from neeco.evaluation.mask_metrics import mean_of
from neeco.experiments.downstream.job import default_conditions
from neeco.experiments.downstream.results import (
    CONFIDENCE,
    KEYS,
    MAIN,
    VERDICTS,
    budget_text,
    data_files,
    equivalent,
    failed_jobs,
    real_curve,
    scores_by_fold,
    summary_text,
    tables_of,
    verdict,
)
from neeco.experiments.machine import hardware_words
from neeco.experiments.tables import Table, csv_text
from neeco.files import write_text
from neeco.report.downstream_figures import (
    course_charts,
    differences,
    line_key,
    question,
    score_chart,
    signed,
    with_labelled,
)
from neeco.report.downstream_shots import Gallery, galleries
from neeco.report.page import REPORT_FILE, split_counts, write_page

FAILED = "failed: "  # how notes on failed trainings begin; they are listed by themselves
CHANCE = round(1 / (1 - CONFIDENCE))  # of so many comparisons that differ in nothing, one is called a difference

Experiment = Mapping[str, Any]


@dataclass(frozen=True)
class Glance:
    """Whether drawn images beside labelled frames help: a line per model, split and condition, a cell per count.

    A cell: difference, verdict, and as good as how many labelled frames alone that is. `judged`: any has a verdict.
    """

    counts: tuple[int, ...]
    rows: tuple[tuple[str, str, str, tuple[tuple[str, str, str], ...]], ...]  # model, split, condition, cells
    judged: bool


def write_downstream_report(output: Path, experiment: dict[str, Any], capture: Capture) -> Path:
    """Write `report.html` and `data/*.csv` into `output`, the folder of a downstream experiment; the page's path.

    experiment: what `run_downstream` returned; what was answered is taken from `output`. Raises NeecoError when a
    picture cannot be read or the page not be written.
    """
    shown = galleries(experiment, capture, output)
    files = {"summary.csv": summary_text(experiment), "shots.csv": _shots_csv(shown), **data_files(experiment)}
    for name, text in files.items():
        write_text(output / "data" / name, text)
    charts = [score_chart(experiment, model, split) for model, split in _models_and_splits(experiment)]
    level, headline = _headline(experiment)
    return write_page(
        output / REPORT_FILE,
        "downstream.html",
        title=f"{capture.root.name}: what drawn images teach",
        name=capture.root.name,
        subtitle="what drawn images teach",
        version=experiment["version"],
        stamps=[machine_words(experiment)],
        models=" and ".join(model["name"] for model in experiment["models"]),
        scratch=not any(model["weights"] for model in experiment["models"]),
        tested=_tested(experiment, capture),
        complete=experiment["complete"],
        level=level,
        headline=headline,
        glance=_glance(experiment),
        answers=_answers(experiment),
        chance=CHANCE,
        charts=[chart for chart in charts if chart],
        key=line_key(experiment),
        course_key=line_key(experiment, alone=True),
        differences=[
            found for model, split in _models_and_splits(experiment) if (found := differences(experiment, model, split))
        ],
        tables=_tables(experiment),
        galleries=shown,
        tints=[(_color(k), name) for k, name in enumerate(experiment["classes"])],
        courses=[chart for model in experiment["models"] for chart in course_charts(experiment, model)],
        trainings=_trainings(experiment),
        inputs=budget_text(experiment),
        held_back=experiment["held_back_every"],
        notes=[note for note in experiment["notes"] if not note.startswith(FAILED)],
        failed=failed_jobs(experiment),
        files=files,
        facts=_facts(experiment, capture),
        settings=_settings(experiment),
    )


def _models_and_splits(experiment: Experiment) -> list[tuple[Mapping[str, Any], str]]:
    return [(model, split) for model in experiment["models"] for split in experiment["splits"]]


def _color(index: int) -> str:
    red, green, blue = PART_COLORS[index % len(PART_COLORS)].astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"


def _beside(experiment: Experiment) -> list[Mapping[str, Any]]:
    """The differences that the experiment is about: drawn images beside labelled frames against these alone."""
    metrics = {model["name"]: MAIN[model["answers"]] for model in experiment["models"]}
    return [
        row
        for row in experiment["paired"]
        if row["metric"] == metrics.get(row["model"]) and question(row, experiment) == "beside"
    ]


def _headline(experiment: Experiment) -> tuple[str, str]:
    """(good, careful or bad; one sentence) of all differences together."""
    rows = _beside(experiment)
    if not rows:
        return "careful", "No condition has drawn images beside labelled frames to hold against these frames alone."
    found = [verdict(row) for row in rows]
    helps, hurts, none_shown = (found.count(word) for word in VERDICTS)
    if helps + hurts + none_shown == 0:
        return "careful", "One fold: whether drawn images help cannot be told from chance; give --folds 5."
    what = "Beside the same labelled frames"
    if len(rows) == helps:
        return "good", f"{what}, drawn images help in {_all(helps)}."
    if len(rows) == hurts:
        return "bad", f"{what}, drawn images hurt in {_all(hurts)}."
    parts = [f"help in {helps}"] if helps else []
    parts += [f"hurt in {hurts}"] if hurts else []
    parts += [f"show no difference in {none_shown}"] if none_shown else []
    told = f"{what}, drawn images {_listed(parts)} of {len(rows)} comparisons."
    return ("good" if helps and not hurts else "bad" if hurts and not helps else "careful"), told


def _all(count: int) -> str:
    return "the only comparison" if count == 1 else f"all {count} comparisons"


def _listed(parts: Sequence[str]) -> str:
    return " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else "".join(parts)


def _glance(experiment: Experiment) -> Glance:
    rows = _beside(experiment)
    counts = tuple(sorted({row["real"] for row in rows}))
    lines: dict[tuple[str, str, str], dict[int, tuple[str, str, str]]] = {}
    for row in rows:
        key = row["model"], row["split"], row["condition"]
        cell = signed(row["difference"]), verdict(row), _as_many(row, experiment)
        lines.setdefault(key, {})[row["real"]] = cell
    order = [(model["name"], split) for model, split in _models_and_splits(experiment)]
    made = [
        (*key, tuple(cells.get(count, ("–", "", "")) for count in counts))
        for key, cells in sorted(lines.items(), key=lambda line: order.index(line[0][:2]))
    ]
    return Glance(counts, tuple(made), any(verdict(row) for row in rows))


def _as_many(row: Mapping[str, Any], experiment: Experiment) -> str:
    """`as good as about 55`: how many labelled frames alone do as well as the first of a difference, over the folds
    that all of these finished; "" where that cannot be read: of one number of frames only, or scores all 0."""
    scores = scores_by_fold(experiment["jobs"], row["model"], row["split"], row["metric"])
    key = row["condition"], row["real"]
    curve = real_curve(scores, key)
    if len(curve) < 2 or not any(score for _, score in curve):
        return ""
    return equivalent(curve, mean_of(list(scores[key].values())))


def _answers(experiment: Experiment) -> list[tuple[str, str, list[tuple[str, str, str]]]]:
    """(model, split, its sentences); a sentence as (before, the verdict in it or "", after)."""
    left = list(experiment["answers"])
    groups = []
    for model, split in _models_and_splits(experiment):
        prefix = f"{model['name']}, {split}: "
        own = [sentence for sentence in left if sentence.startswith(prefix)]
        left = [sentence for sentence in left if not sentence.startswith(prefix)]
        if own:
            groups.append((model["name"], split, [_cut(sentence.removeprefix(prefix)) for sentence in own]))
    return [*groups, *([("", "", [_cut(sentence) for sentence in left])] if left else [])]


def _cut(sentence: str) -> tuple[str, str, str]:
    """A sentence cut about its first verdict."""
    places = {sentence.find(f"; {word} against "): word for word in VERDICTS}
    found = min((place for place in places if place >= 0), default=None)
    if found is None:
        return sentence, "", ""
    start = found + len("; ")
    return sentence[:start], places[found], sentence[start + len(places[found]) :]


def _tables(experiment: Experiment) -> list[tuple[str, str, Table]]:
    """(title, split, table) of the scores; differences have a figure of their own."""
    splits = {f"{model['name']}, split {split}": split for model, split in _models_and_splits(experiment)}
    return [(table.title, splits.get(table.title, ""), table) for table in tables_of(experiment) if table.keys == KEYS]


def _trainings(experiment: Experiment) -> list[list[str]]:
    """Rows of the table of trainings: a line per model, condition and count, means over folds."""
    done = [job for job in experiment["jobs"] if "error" not in job]
    rows = []
    for model, condition, real in dict.fromkeys((job["model"], job["condition"], job["real"]) for job in done):
        same = [job for job in done if (job["model"], job["condition"], job["real"]) == (model, condition, real)]
        width, height = same[0]["input"]
        learning = sum(job["still_learning"] for job in same)
        rows.append(
            [
                f"{model}, {condition}",
                f"{real:,}" if real else "none",
                f"{same[0]['iterations']:,}",
                f"{width}x{height}",
                str(same[0]["batch"]),
                f"{mean_of([job['best_step'] for job in same]):,.0f}",
                f"{learning} of {len(same)}",
                f"{mean_of([job['seconds'] for job in same]):,.0f}",
                f"{mean_of([job['processor_seconds'] for job in same]):,.0f}",
            ]
        )
    return rows


def _tested(experiment: Experiment, capture: Capture) -> str:
    """`12 frames of test and 8 of unseen`."""
    scored = {
        split: numbers["frames"] for job in experiment["jobs"] for split, numbers in job["splits"].items() if numbers
    }
    parts = [(split, scored.get(split, len(capture.split(split)))) for split in experiment["splits"]]
    return _listed([f"{count} {'of' if k else 'frames of'} {split}" for k, (split, count) in enumerate(parts)])


def machine_words(experiment: Experiment) -> str:
    """The machine that trained."""
    machine = experiment["machine"]
    threads = machine["threads_per_worker"] or machine["torch_threads"]
    workers = f", {machine['workers']} trainings at once" if machine["workers"] > 1 else ""
    told = f"{hardware_words(machine)}, {threads} thread{'s' if threads > 1 else ''}"
    return f"{told}{workers}, torch {machine['torch']}"


def command_of(experiment: Experiment) -> str:
    """The command that makes this experiment."""
    teaching, jobs = experiment["teaching"], experiment["jobs"]
    words = ["neeco", "downstream", experiment["capture"]]
    if teaching["sets"]:
        counted = [f":{entry['count']}" if entry["count"] is not None else "" for entry in teaching["sets"]]
        pairs = zip(teaching["sets"], counted, strict=True)
        words += ["--sets", *(f"{entry['name']}={entry['path']}{count}" for entry, count in pairs)]
    words += ["--models", *(model["name"] for model in experiment["models"])]
    counts = sorted({job["real"] for job in jobs})
    words += ["--num-real", *("all" if count and count == experiment["labelled"] else str(count) for count in counts)]
    words += ["--folds", str(experiment["folds"])]
    conditions = list(dict.fromkeys(job["condition"] for job in jobs))
    defaults = default_conditions([entry["name"] for entry in teaching["sets"]])
    if set(conditions) != {word for word in defaults if any(bool(count) == with_labelled(word) for count in counts)}:
        words += ["--conditions", *conditions]
    if teaching["labels"] is not None:
        words += ["--labels", teaching["labels"]]
    for option, key, usual in (("classes", "classes", "instrument"), ("frame-selection", "pick", "spread")):
        words += [f"--{option}", teaching[key]] if teaching[key] != usual else []
    words += ["--splits", *experiment["splits"]]
    for option, key in (("steps", "steps"), ("size", "side"), ("batch", "batch")):
        words += [f"--{option}", str(teaching[key])] if teaching[key] is not None else []
    for model in experiment["models"]:
        words += ["--weights", f"{model['name']}={model['weights']}"] if model["weights"] else []
    if teaching["transforms"] != "transforms.json":
        words += ["--transforms", teaching["transforms"]]
    if teaching["device"] != "auto":
        words += ["--device", teaching["device"]]
    return shlex.join([*words, "--output", "DIR"])


def _facts(experiment: Experiment, capture: Capture) -> list[tuple[str, str]]:
    machine, teaching = experiment["machine"], experiment["teaching"]
    labelled = experiment["labelled"]
    labels = teaching["labels"] or "the capture's truth"
    picked = "spread over the recording, others in every fold" if teaching["pick"] == "spread" else "the first of it"
    told = f"of {labelled:,}, {picked}; labels: {labels}" if labelled else "none"
    return [
        ("command", command_of(experiment)),
        ("capture", experiment["capture"]),
        ("frames", split_counts(capture)),
        ("labelled frames", told),
        *((f"set {entry['name']}", _set_words(entry)) for entry in experiment["sets"]),
        ("classes", ", ".join(experiment["classes"])),
        ("budget", budget_text(experiment)),
        ("machine", machine_words(experiment)),
        ("versions", f"neeco {experiment['version']}, Python {machine['python']}, torch {machine['torch']}"),
    ]


def _set_words(entry: Mapping[str, Any]) -> str:
    """How many images of where, and how they were drawn."""
    told = f"{entry['images']:,} images of {entry['path']}"
    made = entry["made_by"]
    if made is None:
        return f"{told}; how they were made is not known: it has no dataset.json"
    scene = f", drawn from {made['scene']}" if made["scene"] else ""
    settings = made["settings"] or {}
    known = [f"{key} {settings[key]}" for key in ("states", "views", "labels", "seed") if settings.get(key) is not None]
    how = f" ({', '.join(known)})" if known else ""
    return f"{told}{scene}{how}; dataset.json sha256 {entry['sha256'][:12]}"


def _settings(experiment: Experiment) -> list[tuple[str, str]]:
    """(set, all its settings) of sets that tell them."""
    return [
        (entry["name"], json.dumps(entry["made_by"], indent=1, ensure_ascii=False))
        for entry in experiment["sets"]
        if entry["made_by"]
    ]


def _shots_csv(shown: Sequence[Gallery]) -> str:
    header = ["model", "split", "fold", "frame", "why", "condition", "real", "score"]
    rows = [
        {"model": gallery.model, "split": gallery.split, "fold": gallery.fold, "frame": row.frame, "why": row.why}
        | {"condition": shot.condition, "real": shot.real, "score": shot.score}
        for gallery in shown
        for row in gallery.rows
        for shot in row.shots
    ]
    return csv_text(header, rows)
