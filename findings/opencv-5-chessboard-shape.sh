#!/usr/bin/env bash
# OpenCV 5.0.0: findChessboardCorners returns corners of shape (N, 2), projectPoints still (N, 1, 2). NumPy broadcasts
# their difference to (N, N, 2), so a reprojection error computed from `corners - projected` compares every corner with
# every projected point: 151 px in place of 0.0 px. With OpenCV 4.14.0 both are (N, 1, 2) and the same code is correct.
# Why: arrays of OpenCV 5 can have one dimension, so some functions return points without the middle axis, others with
# it. `corners[:, 0]`, a common way to get (N, 2), gives only the x coordinates in OpenCV 5. No error, no warning.
# Write `.reshape(-1, 2)` after every function that returns points; this is correct in both versions.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
cat > check.py <<'PYTHON'
import cv2
import numpy as np

SQUARE, SCALE = 10.0, 20  # mm per square, pixels of the drawn board per square
K = np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]])


def render():
    """Render a board of 10 x 7 squares with a white margin in an oblique view of a camera without distortion."""
    board = np.full((9 * SCALE, 12 * SCALE), 255, np.uint8)
    board[SCALE:-SCALE, SCALE:-SCALE] = np.kron(np.indices((7, 10)).sum(0) % 2 * 255, np.ones((SCALE, SCALE)))
    rotation = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0]
    pose = np.column_stack([rotation[:, :2], [-50.0, -35.0, 150.0]])  # from board points (x, y, 1) in mm
    offset = 0.5 - SCALE
    mm = np.array([[1.0, 0.0, offset], [0.0, 1.0, offset], [0.0, 0.0, SCALE / SQUARE]]) * SQUARE / SCALE
    return cv2.warpPerspective(board, K @ pose @ mm, (640, 480), borderValue=255)


def rms(difference):
    return float(np.sqrt((difference**2).sum(-1).mean()))


version = int(cv2.__version__.split(".")[0])
image = render()
objects = np.zeros((54, 3))
objects[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2) * SQUARE
found, corners = cv2.findChessboardCorners(image, (9, 6))
assert found
corners = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 30, 0.001))
_, rotation, translation = cv2.solvePnP(objects, corners, K, None)
projected, _ = cv2.projectPoints(objects, rotation, translation, K, None)
difference = corners - projected
right = rms(corners.reshape(-1, 2) - projected.reshape(-1, 2))
print("OpenCV", cv2.__version__, "NumPy", np.__version__)
print(f"corners {corners.shape}, projected {projected.shape}, difference {difference.shape}")
print(f"corners[:, 0] {corners[:, 0].shape}")
print(f"reprojection error {rms(difference):.1f} px, of reshaped points {right:.1f} px")
assert right < 0.2
assert projected.shape == (54, 1, 2)
if version == 4:
    assert corners.shape == (54, 1, 2)
    assert rms(difference) == right
else:
    assert corners.shape == (54, 2), "behaviour has changed"
    assert difference.shape == (54, 54, 2)
    assert rms(difference) > 100
PYTHON
venv/bin/pip install --quiet --disable-pip-version-check opencv-python-headless==4.14.0.94 numpy==2.4.6
venv/bin/python check.py
venv/bin/pip uninstall --quiet --yes opencv-python-headless
venv/bin/pip install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy==2.4.6
venv/bin/python check.py
echo "still so"
# Output of 2026-11-28, Python 3.11 on x86-64:
#   OpenCV 4.14.0 NumPy 2.4.6
#   corners (54, 1, 2), projected (54, 1, 2), difference (54, 1, 2)
#   corners[:, 0] (54, 2)
#   reprojection error 0.0 px, of reshaped points 0.0 px
#   OpenCV 5.0.0 NumPy 2.4.6
#   corners (54, 2), projected (54, 1, 2), difference (54, 54, 2)
#   corners[:, 0] (54,)
#   reprojection error 150.9 px, of reshaped points 0.0 px
#   still so
