#!/usr/bin/env bash
# pycocotools 2.0.11: a ground-truth annotation with "id": 0 counts as never found. Four objects in four images, each
# detected by its own box to the pixel, score AP 0.564 and recall 0.75 with ids 0 to 3, AP 1 and recall 1 with ids 1 to 4.
# Why: COCOeval keeps the id of the annotation that a detection matches, and reads 0 as "no match". COCO's format says
# that an id is an integer, and asks for no first one; whoever numbers annotations by enumerate() loses one of them, and
# in a set of one image all of it (AP 0). No error, no warning.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check pycocotools==2.0.11 numpy==2.4.6
venv/bin/python - <<'PYTHON'
import contextlib
import io
from importlib.metadata import version

from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

BOX = [10, 10, 50, 50]


def score(first_id):
    """Return AP over IoU 0.5 to 0.95 and recall of detections that equal the truth, whose ids begin at first_id."""
    truth = COCO()
    truth.dataset = {
        "images": [{"id": image, "width": 100, "height": 100} for image in range(1, 5)],
        "categories": [{"id": 1, "name": "instrument"}],
        "annotations": [
            {"id": first_id + k, "image_id": k + 1, "category_id": 1, "bbox": BOX, "area": 2500, "iscrowd": 0}
            for k in range(4)
        ],
    }
    with contextlib.redirect_stdout(io.StringIO()):
        truth.createIndex()
        found = truth.loadRes([{"image_id": k + 1, "category_id": 1, "bbox": BOX, "score": 0.9} for k in range(4)])
        evaluation = COCOeval(truth, found, "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return round(float(evaluation.stats[0]), 3), round(float(evaluation.stats[8]), 3)


print("pycocotools", version("pycocotools"))
scores = {first_id: score(first_id) for first_id in (1, 0)}
for first_id, (precision, recall) in scores.items():
    print(f"ids {first_id} to {first_id + 3}: AP {precision}, recall {recall}")
assert scores == {1: (1.0, 1.0), 0: (0.564, 0.75)}, "behaviour has changed"
PYTHON
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   pycocotools 2.0.11
#   ids 1 to 4: AP 1.0, recall 1.0
#   ids 0 to 3: AP 0.564, recall 0.75
#   still so
