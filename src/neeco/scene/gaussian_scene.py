"""The learned model: canonical Gaussians, the deformation that poses them, and their light.

`GaussianScene.at` is where a state, poses and joints, becomes posed Gaussians.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, TypeGuard

import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.model import Camera, Instrument, InstrumentState, State
from neeco.geometry.rotations import rigid_from_vector
from neeco.raster import rasterize
from neeco.raster.devices import CachedPredicate
from neeco.raster.types import Gaussians, Headlight, Rendering, Shadow
from neeco.scene.canonical import SH_COEFFICIENTS, CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Deformation, Deltas, Perturbation
from neeco.scene.drawable import ArticulatedMotion, DrawableScene, Recorded, Skeleton
from neeco.scene.method import Stored
from neeco.scene.state_corrections import StateCorrections
from neeco.scene.visibility import VISIBILITY, measure_visibility, unobserved_share

MAX_LAMPS = 3  # a laparoscope has up to three light guides
INITIAL_SHADOW_WIDTH = 0.01  # slope
CANONICAL_SHAPES = {  # of one Gaussian
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (SH_COEFFICIENTS - 1, 3),
}


class GaussianScene(DrawableScene):
    """A learned scene of Gaussians: `at` poses them in a state, for any method; `render` renders them.

    `registration` [7] is one constant tracker-to-world correction (rotation vector in rad about `center`, translation
    in mm, log scale about `center`), applied to every instrument pose; zero unless refined. `base_corrections` [I, 6]
    correct each instrument's poses before that (rotation vector in rad about `center`, translation in mm): the error of
    its robot's base, zero unless estimated from the images. Before both, `state_corrections` apply state-dependent
    corrections of poses and readings. `falloff` (tissue, instruments) and `vignette` are the headlight (see
    `Headlight`), `shadow_offsets`, `shadow_strengths` (0: unused lamp) and `shadow_width` the instruments' shadows on
    the tissue (see `Shadow`). `background` in [0, 1] is the grey behind everything.
    """

    has_gaussians = True

    center: Tensor
    registration: Tensor

    def __init__(
        self,
        method: str,
        canonical: CanonicalGaussians,
        deformation: Deformation,
        instruments: tuple[Instrument, ...],
        recorded: Recorded,
        center: Tensor,
    ) -> None:
        super().__init__(method, instruments, recorded)
        self.canonical = canonical
        self.deformation = deformation
        self.settings = deformation.settings
        self.sh_degree = 0
        self.background = 0.0
        device = canonical.means.device
        self.register_buffer("center", center.float().to(device))  # [3] mm, middle of the tissue
        zeros = partial(torch.zeros, device=device)
        self.registration = nn.Parameter(zeros(7))
        self.base_corrections = nn.Parameter(zeros(len(instruments), 6))
        self.state_corrections = StateCorrections(instruments, device)
        self.falloff = nn.Parameter(zeros(2))
        self.vignette = nn.Parameter(zeros(2))
        self.shadow_offsets = nn.Parameter(zeros(MAX_LAMPS, 3))
        self.shadow_strengths = nn.Parameter(zeros(MAX_LAMPS))
        self.shadow_width = nn.Parameter(torch.full((), INITIAL_SHADOW_WIDTH, device=device))
        self._shines = CachedPredicate(lambda strengths: (strengths > 0).any())
        self._corrects = CachedPredicate(lambda registration: registration.any())
        self._corrects_bases = CachedPredicate(lambda corrections: corrections.any())

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GaussianScene:
        """Move the canonical Gaussians with the modules (called by `to`)."""
        super()._apply(fn, recurse)
        self.canonical = self.canonical.map(fn)
        return self

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return (tensors, JSON-able fields) from which, with the state of its modules, `load` makes the scene."""
        canonical = self.canonical
        return {f"canonical.{name}": tensor for name, tensor in canonical.tensors().items()}, {
            "counts": list(canonical.counts),
            "sh_degree": self.sh_degree,
            "background": self.background,
        }

    @classmethod
    def load(cls, deformation: Deformation, stored: Stored) -> GaussianScene:
        """Return the scene that `pack` stored. Raises ValueError or LookupError where it does not fit."""
        header = stored.header
        prefix = "canonical."
        canonical = _canonical(
            {name.removeprefix(prefix): t for name, t in stored.tensors.items() if name.startswith(prefix)},
            tuple(header["counts"]),
            len(stored.instruments),
        )
        center = canonical.means.new_zeros(3)
        scene = cls(header["method"], canonical, deformation, stored.instruments, stored.recorded, center)
        scene.sh_degree = int(header["sh_degree"])
        if scene.sh_degree < 0 or (scene.sh_degree + 1) ** 2 - 1 > canonical.sh_rest.shape[1]:
            raise ValueError(f"sh_degree is {scene.sh_degree}, which does not fit its harmonics")
        # older scenes call it backdrop, or have none
        scene.background = float(header.get("background", header.get("backdrop", 0.0)))
        if not 0 <= scene.background <= 1:
            raise ValueError(f"its background is {scene.background}, not a grey in [0, 1]")
        return scene

    def at(self, state: State, perturbation: Perturbation = UNPERTURBED) -> Gaussians:
        """Return the Gaussians posed in `state`, float32. Gradients reach instrument poses that require them.

        Raises NeecoError when the state lacks an instrument or joint that the scene has.
        """
        canonical = self.canonical
        posed = self.deformation.pose(canonical, self.registered(state), perturbation)
        tissue, instruments = canonical.counts[0], len(canonical) - canonical.counts[0]
        shadow = None
        if self.casts_shadow:
            strengths = self.shadow_strengths.clamp(0.0, 1.0)
            shadow = Shadow(canonical.of_instruments, self.shadow_offsets, strengths, self.shadow_width)
        falloff = torch.cat([self.falloff[:1].expand(tissue), self.falloff[1:].expand(instruments)])
        return Gaussians(
            means=posed.means,
            quats=posed.quats,
            scales=posed.scales,
            opacities=torch.sigmoid(canonical.opacity_logits),
            sh=canonical.spherical_harmonics(self.sh_degree),
            sh_frames=posed.sh_frames,
            headlight=Headlight(falloff, self.vignette, shadow),
            background=canonical.means.new_full((3,), self.background) if self.background else None,
        )

    def visibility(self) -> Tensor:
        """Return the visibility [N, 12] of each Gaussian in the training frames (see `neeco.scene.visibility`), as
        measured at the end of training, or computed once here."""
        if VISIBILITY not in self.canonical.extras:
            measured = measure_visibility(self.canonical, self.recorded, self.at)
            self.canonical = self.canonical.with_extras(**{VISIBILITY: measured})
        return self.canonical.extras[VISIBILITY]

    def unobserved(self, posed: Gaussians, camera: Camera) -> Tensor:
        """Return the share [N] in [0, 1] of each posed Gaussian, viewed by `camera`, that no training frame observed
        from a similar direction."""
        return unobserved_share(self.visibility(), posed, camera)

    @property
    def casts_shadow(self) -> bool:
        """Whether a lamp next to the lens was found, and there are instruments to cast its shadow."""
        return self._shines(self.shadow_strengths) and len(self.canonical) > self.canonical.counts[0]

    def registered(self, state: State) -> State:
        """Return `state` with the learned corrections of states, bases and of tracker to world.

        Raises NeecoError for poses that are not rigid and joints far beyond their limits (see `State.check`).
        """
        state.check(self.instruments, fitted=True)
        state, registration = self.state_corrections.corrected(state), self.registration
        # a tensor on the device "meta" has no values to test
        corrects = registration.requires_grad or registration.is_meta or self._corrects(registration)
        bases: dict[str, Tensor] = {}
        if not self.base_corrections.is_meta and self._corrects_bases(self.base_corrections):
            bases = dict(zip((item.name for item in self.instruments), self.base_corrections, strict=True))
        if not state.instruments or not (corrects or bases):
            return state
        center, moved = self.center, dict(state.instruments)
        for name, instrument_state in state.instruments.items():
            pose = instrument_state.pose.to(center)
            if name in bases:
                pose = _moved_about(center, pose, bases[name])
            if corrects:
                pose = _moved_about(center, pose, registration[:6], registration[6].exp())
            moved[name] = InstrumentState(pose, instrument_state.joints)
        return dataclasses.replace(state, instruments=moved)

    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        """Render `state` from the recorded `camera`, differentiable; `labels`: with label channels, if any."""
        channels = self.label_channels() if labels and self.label_names else None
        return rasterize(self.at(state), camera, channels=channels)

    def motion(self) -> ArticulatedMotion | None:
        """Return the articulation if it determines all motion, else None."""
        return self.deformation.motion(self.canonical)

    def torch_threads(self) -> AbstractContextManager[None]:
        """Use the number of torch's threads that renders the scene fastest."""
        return self.deformation.torch_threads()

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians."""
        return len(self.canonical)

    @property
    def label_names(self) -> tuple[tuple[str, str], ...]:
        """(instrument, part) of each label column; mask id = index + 1, 0 is tissue."""
        return self.deformation.label_names

    def label_channels(self) -> Tensor:
        """Return the soft membership [N, L] in [0, 1] of each Gaussian; the remainder to 1 is tissue."""
        return self.deformation.label_channels(self.canonical)

    def deltas(self, state: State) -> Deltas:
        """Return the change of each Gaussian from canonical to `state`."""
        return self.deformation.deltas(self.canonical, self.registered(state))

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        """Return named 3D points [3] mm, world frame, per instrument."""
        return self.deformation.keypoints(self.registered(state))

    def skeleton(self) -> Skeleton:
        """Return the pairs of keypoint names that a line joins."""
        return self.deformation.skeleton()


def _moved_about(center: Tensor, pose: Tensor, vector: Tensor, scale: Tensor | None = None) -> Tensor:
    """Return a pose [4, 4] scaled about `center` [3] by `scale`, then moved by `vector` [6] (rotation vector in rad
    about `center`, translation in mm)."""
    correction = rigid_from_vector(vector)
    arm = pose[:3, 3] - center
    arm = arm if scale is None else arm * scale
    translation = correction[:3, :3] @ arm + center + correction[:3, 3]
    top = torch.cat([correction[:3, :3] @ pose[:3, :3], translation[:, None]], 1)
    return torch.cat([top, pose[3:]])


def is_gaussian(scene: DrawableScene) -> TypeGuard[GaussianScene]:
    """Whether `scene` consists of Gaussians, which can be posed and labelled."""
    return scene.has_gaussians


def require_gaussians(scene: DrawableScene, asked_by: str) -> GaussianScene:
    """Return `scene`, which must consist of Gaussians. Raises NeecoError, naming the option or verb `asked_by`, for a
    radiance field."""
    if not is_gaussian(scene):
        raise NeecoError(
            f"{asked_by}: method {scene.method} has no Gaussians to pose or label; use a run of another method, "
            "such as kinematic"
        )
    return scene


def _canonical(tensors: dict[str, Tensor], counts: tuple[int, ...], instruments: int) -> CanonicalGaussians:
    """Return the Gaussians. Raises ValueError for wrong shapes, types or numbers; without instruments, all bodies are
    tissue."""
    fits = instruments == 0 or len(counts) in (1, 1 + instruments)
    if not fits or not all(isinstance(count, int) and count >= 0 for count in counts):
        raise ValueError(f"counts of {len(counts)} bodies do not fit {instruments} instruments")
    if missing := [name for name in CANONICAL_SHAPES if name not in tensors]:
        raise ValueError(f"{missing[0]} is missing")
    for name, tensor in tensors.items():
        shape, wanted = tuple(tensor.shape), (sum(counts), *CANONICAL_SHAPES.get(name, tensor.shape[1:]))
        if shape != wanted:
            raise ValueError(f"{name} has shape {list(shape)}, not {list(wanted)}")
        if tensor.dtype != torch.float32:
            raise ValueError(f"{name} is {tensor.dtype}, not float32")
    return CanonicalGaussians.from_tensors(tensors, counts)
