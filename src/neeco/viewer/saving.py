"""Files that a user saves in the viewer: states for `synthesize --states`, and single labelled images."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import torch

from neeco.base.files import LOCK_WAIT_S, own_folder, read_text, write_text
from neeco.capture.model import State
from neeco.capture.readers import StateLine, read_states
from neeco.capture.writer import camera_to_json, state_to_json
from neeco.labels.annotation import annotate
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.scene.gaussian_scene import require_gaussians
from neeco.synthesis.contact import labels_of
from neeco.synthesis.samplers import DrawnCameras, moved_camera
from neeco.synthesis.settings import RECORDED_SIZE, Settings, SizeSettings
from neeco.synthesis.writers.folder import encoded_sample, load_record, record_path
from neeco.viewer.runs import LoadedRun

FOLDER = "kept"  # of the run
STATES, SAMPLES = "states.jsonl", "samples"


class SavedStates:
    """Writes into one run's folder `kept/`, whoever of several users asks. Any thread may call it. size: of images."""

    def __init__(self, run: Path, size: SizeSettings = RECORDED_SIZE) -> None:
        self.size = size
        self.folder = Path(run) / FOLDER
        self._lock = threading.Lock()

    @property
    def states_path(self) -> Path:
        """File for `synthesize --states`."""
        return self.folder / STATES

    def add(self, loaded: LoadedRun, state: State, world_from_camera: np.ndarray) -> int:
        """Add a state and the camera [4, 4] that sees it (OpenCV axes, mm); returns how many are saved. Raises
        NeecoError where the file cannot be written, or holds states of another scene."""
        line = json.dumps(state_to_json(state) | {"camera": camera_to_json(world_from_camera)}, allow_nan=False)
        with self._lock, own_folder(self.folder, wait_s=LOCK_WAIT_S):
            count = len(self.read(loaded))
            before = read_text(self.states_path, "states").splitlines() if count else []
            write_text(self.states_path, "".join(f"{entry}\n" for entry in [*before, line]))
            return count + 1

    def read(self, loaded: LoadedRun) -> list[StateLine]:
        """Read the saved states, checked against the scene. Raises NeecoError."""
        if not self.states_path.exists():
            return []
        return read_states(self.states_path, loaded.scene.instruments)

    def save_image(self, loaded: LoadedRun, state: State, world_from_camera: np.ndarray) -> Path:
        """Write one labelled image as `synthesize` does, of the recorded cameras' intrinsics, as large as was asked;
        returns the image's path. Raises NeecoError for a scene without labels, and where it cannot be written."""
        scene = require_gaussians(loaded.scene, "save labelled image")
        labeller = CompositedLabels(scene)
        camera = DrawnCameras(self.size)(moved_camera(loaded.recorded.cameras[0], world_from_camera))
        with scene.torch_threads(), torch.no_grad():
            drawing = draw_layers(scene, labeller, state, camera, Settings.min_component)
            labels = labels_of(scene, drawing, annotate(scene, drawing, labeller.names))
        root = self.folder / SAMPLES
        with self._lock, own_folder(root, wait_s=LOCK_WAIT_S):
            index = 0
            while record_path(root, index).exists() and load_record(root, index) is not None:
                index += 1
            record = encoded_sample(index, drawing, labels).write(root)
        return root / record["image"]
