"""Interface of methods, of Gaussians or not."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from neeco.capture.model import Capture, Instrument
from neeco.raster.native import torch_threads
from neeco.scene.drawable import DrawableScene, Recorded
from neeco.scene.training_session import Report, RunLength, Session
from neeco.scene.training_views import TrainingViews

# Plain 3DGS: no part of the paper's dynamic training adjustment acts.
PLAIN_TRAINING: Mapping[str, Any] = {
    "schedule.density_interval": "off",
    "schedule.opacity_reset": "off",
    "schedule.gradient_threshold": "off",
    "schedule.sh_order": "off",
    "schedule.frame_order": "off",
    "schedule.compensation": "off",
}


@dataclass(frozen=True)
class NoSettings:
    """Settings of a method without its own."""


@dataclass(frozen=True)
class Stored:
    """Content of a scene's file."""

    settings: Any  # the method's own, an instance of its `Settings`
    instruments: tuple[Instrument, ...]
    recorded: Recorded
    tensors: Mapping[str, Tensor]  # by name
    header: Mapping[str, Any]


class Method:
    """A method is one class in one file or folder under `methods/`, or an entry point of another package in the group
    `neeco.methods`, found by its name, `method`; no other module names it.

    `Settings` is a frozen dataclass of its own settings (`--set deformation.NAME=VALUE`), each with a type and a
    default; its docstring describes them. `training_defaults` are fields of the training config that differ from the
    paper's, dotted names as in `neeco train --set`. `presets`: sets of such fields by name, of a method whose
    `Settings` have a field `preset`; `--set deformation.preset=NAME` sets them before all other `--set`.
    """

    method: ClassVar[str]
    former_names: ClassVar[tuple[str, ...]] = ()  # of the method in older versions, which are still accepted
    Settings: ClassVar[type[Any]] = NoSettings
    training_defaults: ClassVar[Mapping[str, Any]] = PLAIN_TRAINING
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    needs_instruments: ClassVar[bool] = False  # whether it learns from recorded instrument states alone
    needs_times: ClassVar[bool] = False  # whether it learns from recorded times alone
    actions: ClassVar[tuple[str, ...]] = ()  # what events of the schedule can have it do (`Deformation.act`)
    enough_frames: ClassVar[int] = 0  # training frames of fewer than which a run has fewer iterations by default
    has_gaussians: ClassVar[bool] = True  # False: nothing to rasterise, pose or densify; an image takes seconds
    large_operations: ClassVar[bool] = False  # whether torch's operations are large enough to gain from several threads

    @classmethod
    def moves_stated_links(cls, settings: Any) -> bool:
        """Whether links move by an instrument's stated kinematics, where it has any."""
        return False

    @classmethod
    def learned_joints(
        cls, instrument: Instrument, joints: tuple[str, ...], settings: Any, report: Report
    ) -> tuple[str, ...]:
        """Return the `joints` that are learned of an instrument without stated links; `report` those that are left out
        or uncertain."""
        return joints

    @classmethod
    def torch_threads(cls) -> AbstractContextManager[None]:
        """Use one of torch's threads where scenes are posed and rendered, or all where the operations are large."""
        return nullcontext() if cls.large_operations else torch_threads(1)

    @classmethod
    def resolved(cls, settings: Any, begun: Any | None = None) -> Any:
        """Return `settings` with machine-dependent choices decided: by this machine, or as in the settings of a run
        that was `begun` elsewhere."""
        return settings

    @classmethod
    def session(
        cls, capture: Capture, views: TrainingViews, settings: Any, length: RunLength, seed: int, scene: Any | None
    ) -> Session:
        """Return a session at iteration 0 of a method without Gaussians, on the views' device, with a new scene or the
        `scene` of a checkpoint. `settings` are the method's own. Methods with Gaussians share one session
        (`neeco.training.session`).

        Raises NeecoError where the capture lacks what the method needs.
        """
        raise NotImplementedError

    @classmethod
    def load(cls, stored: Stored) -> DrawableScene:
        """Return the scene of a method without Gaussians from a file's content, without the state of its modules, which
        the caller loads.

        Raises ValueError, LookupError or RuntimeError where the file does not fit.
        """
        raise NotImplementedError
