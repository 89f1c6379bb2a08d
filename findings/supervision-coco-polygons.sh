#!/usr/bin/env bash
# supervision 0.31.2 (PyPI): masks of COCO polygons come out larger than the annotation's own area; masks of COCO run
# lengths do not.
#
# COCO's polygons are outlines in continuous coordinates: the square (3, 3) to (6, 6) is 3 x 3 px, as pycocotools 2.0.11
# fills it, and as the annotation's `area` says. Expected: DetectionDataset.from_coco(force_masks=True) gives 9 px, from
# either form of the same mask. Seen: 9 px of run lengths and 16 px of the polygon, whose corners are taken as pixels
# that belong to it: a row and a column more. An instrument's jaw, 3 px wide, scores an IoU of 0.5 to 0.8 against itself.
# Exit status 0: as described. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv env
env/bin/pip install --quiet --disable-pip-version-check supervision==0.31.2 pycocotools==2.0.11
env/bin/python - <<'PY'
import json, sys, warnings
warnings.filterwarnings("ignore")
import numpy as np
import supervision
from PIL import Image
from pycocotools import mask as coco_mask

mask = np.zeros((10, 10), np.uint8)
mask[3:6, 3:6] = 1
polygon = [[3.0, 3.0, 6.0, 3.0, 6.0, 6.0, 3.0, 6.0]]
runs = {"size": [10, 10], "counts": [33, 3, 7, 3, 7, 3, 44]}
found = {"pycocotools, polygon": int(coco_mask.area(coco_mask.frPyObjects(polygon, 10, 10))[0])}
Image.fromarray(np.zeros((10, 10, 3), np.uint8)).save("1.png")
for name, segmentation in (("polygon", polygon), ("run lengths", runs)):
    annotation = {"id": 1, "image_id": 1, "category_id": 1, "iscrowd": 0, "area": 9, "bbox": [3, 3, 3, 3]}
    content = {"images": [{"id": 1, "file_name": "1.png", "width": 10, "height": 10}],
               "categories": [{"id": 1, "name": "jaw"}], "annotations": [annotation | {"segmentation": segmentation}]}
    json.dump(content, open(f"{name}.json", "w"))
    data = supervision.DetectionDataset.from_coco(".", f"{name}.json", force_masks=True)
    found[f"supervision, {name}"] = int(next(iter(data))[2].mask.sum())
for name, pixels in found.items():
    print(f"{name}: {pixels} px")
same = list(found.values()) == [9, 16, 9]
print("as described" if same else "it has changed")
sys.exit(not same)
PY
# Output of 2026-11-30:
#   pycocotools, polygon: 9 px
#   supervision, polygon: 16 px
#   supervision, run lengths: 9 px
#   as described
