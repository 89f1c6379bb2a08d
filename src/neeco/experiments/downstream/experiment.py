"""`downstream`: models taught with recorded and with drawn images under one budget, tested on recorded frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from neeco import __version__
from neeco.experiments.downstream.conditions import (
    HELD_BACK_EVERY,
    REAL,
)
from neeco.experiments.downstream.job import JOB_FILE, as_settings
from neeco.experiments.downstream.model import model_class
from neeco.experiments.downstream.plan import FILE, SCHEMA, DownstreamPlan
from neeco.experiments.downstream.results import answers_of, comparisons, summarise_folds
from neeco.experiments.downstream.samples import (
    CLASSES,
    DataSet,
)
from neeco.experiments.machine import machine
from neeco.experiments.study import JobEvent, run_jobs, threads_per_worker
from neeco.files import own_folder, read_json, write_json
from neeco.raster.devices import device_of


def run_downstream(plan: DownstreamPlan, news: Callable[[JobEvent], None] | None = None) -> dict[str, Any]:
    """Teach and test every model in every condition on every fold; writes downstream.json, and returns what it holds.

    Given again after an interruption it goes on where it stopped; given again with more models, sets, conditions,
    labelled frames or folds, it adds them. A job that fails is told in its place.
    """
    output = plan.spec.output
    with own_folder(output):
        finished: dict[int, dict[str, Any]] = {}
        for index, job in enumerate(plan.jobs):
            if (file := job.folder / JOB_FILE).exists():
                finished[index] = read_json(file)

        def keep(latest: JobEvent) -> None:
            if latest.result is not None:
                finished[latest.index] = latest.result
                write_json(output / FILE, document(plan, [finished[k] for k in sorted(finished)]))
            if news:
                news(latest)

        results = run_jobs(plan.jobs, plan.spec.workers, keep, {plan.teaching.capture: plan.capture})
        result = document(plan, results) | {"complete": True}
        write_json(output / FILE, result)
    return result


def document(plan: DownstreamPlan, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """downstream.json as far as these results tell it."""
    spec, teaching = plan.spec, plan.teaching
    kinds = {name: model_class(name) for name in spec.models}
    answers = {name: kind.answers for name, kind in kinds.items()}
    models = [
        {
            "name": name,
            "answers": kind.answers,
            "steps": teaching.steps_of(kind),
            "batch": teaching.batch_of(kind),
            "input": list(teaching.input_of(kind, plan.size)),
            "weights": str(spec.weights[name].absolute()) if name in spec.weights else None,
        }
        for name, kind in kinds.items()
    ]
    done = [job for job in results if "error" not in job]
    names = [data.name for data in teaching.sets]
    made: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "complete": False,
        "capture": str(teaching.capture.absolute()),
        "machine": machine(device_of(teaching.device, drawing=False))
        | {
            "workers": spec.workers,
            "threads_per_worker": threads_per_worker(spec.workers) if spec.workers > 1 else None,
        },
        "teaching": as_settings(teaching),
        "classes": list(CLASSES[teaching.classes]),
        "splits": list(teaching.splits),
        "folds": spec.folds,
        "labelled": plan.labelled,
        "held_back_every": HELD_BACK_EVERY,
        "sets": [
            data.described() | {"images": plan.images[data.name], "made_by": _made_by(data)} for data in teaching.sets
        ],
        "models": models,
        "jobs": list(results),
        "summary": summarise_folds(results, answers, teaching.splits),
        "paired": comparisons(done, answers, teaching.splits, names),
        "notes": list(plan.notes) + _told_by(results),
    }
    return made | {"answers": answers_of(made)}


def failed_jobs(experiment: Mapping[str, Any]) -> list[str]:
    """`model, condition, …: why` of every job that failed."""
    return [
        f"{job['model']}, {job['condition']}, {job['real']} labelled, fold {job['fold']}: {job['error']}"
        for job in experiment["jobs"]
        if "error" in job
    ]


def _told_by(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the jobs' courses say of the numbers."""
    notes = [f"failed: {line}" for line in failed_jobs({"jobs": results})]
    done = [job for job in results if "error" not in job]
    late = sorted({f"{job['model']}, {job['condition']}" for job in done if job["still_learning"]})
    if late:
        notes.append(f"still getting better at the last step: {'; '.join(late)}; give more --steps")
    for model in dict.fromkeys(job["model"] for job in done):
        taught = [job for job in done if job["model"] == model and job["condition"] == REAL]
        most = max((job["real"] for job in taught), default=0)  # fewer labels alone make it miss what they do not show
        gaps = [
            scores["precision"] - scores["recall"]
            for job in taught
            if job["real"] == most
            for scores in job["splits"].values()
            if scores.get("precision") is not None and scores.get("recall") is not None
        ]
        if gaps and abs(sum(gaps) / len(gaps)) > 0.02:
            how = "over-segments" if sum(gaps) < 0 else "under-segments"
            notes.append(
                f"{model}: taught with {most} labelled frames alone it {how} (precision - recall "
                f"{sum(gaps) / len(gaps):+.3f}); that flatters labels with the opposite fault"
            )
    return notes


def _made_by(data: DataSet) -> dict[str, Any] | None:
    """What dataset.json says of how a set was drawn; None where there is none."""
    stated = data.info()
    return (
        None
        if stated is None
        else {key: stated.get(key) for key in ("settings", "scene", "scene_sha256", "version", "complete")}
    )
