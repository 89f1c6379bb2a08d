"""A random world: one capture's properties, each drawn from a stated distribution, and the scene that they make.

`draw_world(seed)` draws, `touched` the same world with contact (`touch.py`); `World.scene()` and `World.place()` say
what to render. Lengths mm, angles rad unless named. Two worlds of one seed are equal.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from rendered.errors import EXACT, ErrorModel
from rendered.exposure import Processor
from rendered.instrument import Blade, Design, Material
from rendered.motion import Path
from rendered.render import Lamps, Lens, Place
from rendered.scenes import DEGREE, Joint, Mount, SceneSpec
from rendered.tissue import ORGANS, Tissue
from rendered.touch import Touch, draw_touch
from rendered.wristed import Encoders, WristedDesign

Triple = tuple[float, float, float]
SIZES = ((192, 144), (208, 160), (256, 192), (320, 256))
RESOLUTION = 1200  # texels along the tissue's side

# background: relief of which organ, its mean linear colour, contrast of its texture, share of wet highlights
BACKGROUNDS: dict[str, tuple[str, Triple, float, float]] = {
    "bowel": ("bowel", (0.60, 0.29, 0.22), 1.0, 1.0),
    "stomach": ("stomach", (0.52, 0.17, 0.12), 1.0, 1.0),
    "liver": ("stomach", (0.26, 0.075, 0.055), 0.8, 0.9),
    "fat": ("bowel", (0.70, 0.47, 0.19), 0.7, 0.7),
    "peritoneum": ("stomach", (0.66, 0.42, 0.36), 0.8, 0.9),
    "spleen": ("bowel", (0.22, 0.06, 0.10), 0.7, 1.0),
    "dark cloth": ("sheet", (0.035, 0.095, 0.11), 0.8, 0.0),
    "bright cloth": ("sheet", (0.48, 0.58, 0.60), 0.8, 0.0),
    "phantom": ("stomach", (0.66, 0.36, 0.27), 0.25, 0.3),
    "cavity": ("bowel", (0.085, 0.016, 0.013), 0.9, 0.9),
}
# shaft: linear colour, whether it is bare metal
FINISHES: dict[str, tuple[Triple, bool]] = {
    "black": ((0.012, 0.012, 0.013), False),
    "dark grey": ((0.13, 0.132, 0.14), False),
    "steel": ((0.62, 0.63, 0.65), True),
    "white": ((0.80, 0.80, 0.78), False),
    "blue": ((0.04, 0.11, 0.38), False),
}
# jaws for a shaft of radius 4 mm: lengths of both, half widths at heel and tip along x and y, sideways bend
JAWS: dict[str, tuple[float, float, tuple[float, float], tuple[float, float], float]] = {
    "scissors": (22.0, 21.0, (0.7, 0.4), (1.8, 0.6), 4.5),
    "grasper": (15.0, 15.5, (2.3, 1.8), (1.9, 1.3), 0.0),
    "driver": (11.0, 10.0, (1.5, 1.1), (1.4, 0.9), 0.0),
    "dissector": (19.0, 18.5, (1.2, 0.7), (1.5, 0.7), 3.0),
    "forceps": (17.0, 17.0, (1.0, 1.0), (1.1, 0.8), 0.0),
}
KINDS = ("straight", "hinge", "wrist")
SCOPES = ("moving", "still", "stereo")
STATES = ("exact", "tracker", "encoders", "independent")
LINKS = ("exact", "off", "none")
TRAIN_FRAMES = (12, 15, 20, 30, 60, 120)


@dataclass(frozen=True, kw_only=True)
class World:
    """What was drawn. Fields in `describe()` make world.json."""

    seed: int
    size: tuple[int, int]  # px
    # instrument
    kind: str
    radius: float  # of the shaft
    finish: str
    gloss: float  # 0 matt, 1 mirror-like
    rings: bool  # bright rings around the shaft
    jaws: str
    moving_jaws: float  # share of the opening that the first jaw takes
    # background
    background: str
    texture: float  # times the background's contrast
    wet: bool
    # light and camera
    lamps: tuple[Triple, ...]  # camera frame
    shadow_sharpness: float
    contact: float  # as `Lamps` has it
    exposure: float
    balance: Triple  # gains of the colours
    automatic: bool  # exposure and white balance follow what is seen
    focal: float  # times that of the default lens
    noise: float  # times the default sensor's
    blur: float  # px at a height of 256
    scope: str
    # recording
    frames: int  # to train on
    coverage: float  # share of the motion's time that training frames show
    roll: float  # half of the range, training frames
    depth: float  # of the hinge above the tissue's mean
    aside: tuple[float, float]
    azimuth: float  # from which side the shaft comes
    # states
    states: str
    error_scale: float  # times usual errors
    wrong: float  # share of the training states that are mirrored, or another moment's
    links: str
    joints: bool  # whether they are logged
    stated: bool  # whether uncertainties are stated
    base: float  # error of a robot's base, times a usual one
    frame_off: float  # mm along the shaft, of stated links in the tracked frame
    # how it is trained
    scale: float  # --scale
    touch: Touch | None = None  # how the instrument touches the tissue, where it does

    def describe(self) -> dict[str, Any]:
        """world.json."""
        own = asdict(self)
        if self.touch is None:
            del own["touch"]
        return {"schema": "neeco-world/1", **own}

    @property
    def lens(self) -> Lens:
        """The pinhole of the images; the vertical field of view does not depend on their size."""
        width, height = self.size
        return Lens(width, height, Lens.focal * self.focal * height / Lens.height)

    @property
    def processor(self) -> Processor:
        """What the camera makes of light."""
        gains = tuple(float(self.exposure * gain) for gain in self.balance)
        return Processor(gains, blur_px=self.blur, noise=self.noise)  # type: ignore[arg-type]

    def place(self) -> Place:
        """Tissue, instrument, lamps and lens."""
        organ, color, contrast, wet = BACKGROUNDS[self.background]
        tissue = recoloured(
            ORGANS[organ](self.seed % 2**31, RESOLUTION), color, contrast * self.texture, wet * self.wet
        )
        spec = self.scene()
        return Place(tissue, spec.design, spec.lamps, self.lens)

    def scene(self) -> SceneSpec:
        """The scene, its sensors as drawn: poses of a tracker err as trackers do, others are exact here."""
        rng = np.random.default_rng((self.seed, 7))
        design = self._design()
        power = 1.35
        lamps = Lamps(self.lamps, power, 100.0, 2.0, self.shadow_sharpness, self.contact)
        hinge = (self.aside[0], self.aside[1], self.depth)
        away = 120 * np.array([math.cos(self.azimuth), math.sin(self.azimuth)])
        path = Path(
            camera_center=(self.aside[0] / 2, -18.0, 108.0),
            camera_sway=(11.0, 10.0, 10.0),
            look_at=(0.0, 0.0, 5.0),
            look_sway=(6.0, 5.0),
            camera_roll=float(rng.uniform(-0.5, 0.5)),
            trocar=(float(away[0]), float(away[1]), self.depth + 80.0),
            hinge_center=hinge,
            hinge_sway=(11.0, 9.0, 6.0),
            hinge_extra=tuple(rng.uniform(-11, 11, 3).tolist()),
            opening_train=0.0 if self.kind == "straight" else 46 * DEGREE,
            opening_most=0.0 if self.kind == "straight" else 70 * DEGREE,
            roll_middle=float(rng.uniform(-math.pi, math.pi)),
            roll_train=self.roll,
            roll_most=self.roll + 35 * DEGREE,
            wrist_train=(38 * DEGREE, 34 * DEGREE) if self.kind == "wrist" else (),
            wrist_most=(55 * DEGREE, 50 * DEGREE) if self.kind == "wrist" else (),
        )
        tracked = replace(ErrorModel(), **_scaled(self.error_scale)) if self.states == "tracker" else EXACT
        if self.scope != "moving":
            tracked = replace(
                tracked, scale=1.0, back_mm=0.0, aside_mm=0.0, turn_rad=0.0, camera_jitter_mm=0.0, camera_jitter_rad=0.0
            )
        elif self.states != "exact":  # structure from motion errs, however poses are recorded
            usual = ErrorModel()
            tracked = replace(
                tracked, camera_jitter_mm=usual.camera_jitter_mm, camera_jitter_rad=usual.camera_jitter_rad
            )
        encoders = None
        if self.kind == "wrist":
            size = 4 * DEGREE * self.error_scale if self.states == "encoders" else 0.0
            offsets = tuple(rng.uniform(-size, size, 2).tolist())
            encoders = Encoders(offsets, 0.2 * size, 0.3 * DEGREE if size else 0.0)  # type: ignore[arg-type]
        return SceneSpec(
            organ=BACKGROUNDS[self.background][0],
            design=design,
            lamps=lamps,
            path=path,
            mount=Mount(
                (float(rng.normal(0, 2)), float(rng.normal(0, 2)), float(-rng.uniform(5, 35))),
                spin=float(rng.uniform(-math.pi, math.pi)),
                tilt=float(rng.uniform(0, 15)) * DEGREE,
                tilt_towards=float(rng.uniform(-math.pi, math.pi)),
            ),
            joint=Joint(zero=float(rng.uniform(-0.2, 0.2)), sign=int(rng.choice((-1, 1))), limits=(-1.8, 1.8)),
            seed=self.seed % 2**31,
            world_turn=tuple(rng.uniform(-1.5, 1.5, 3).tolist()),
            world_shift=tuple(rng.uniform(-200, 200, 3).tolist()),
            errors=tracked,
            encoders=encoders,
        )

    def _design(self) -> Design:
        size = self.radius / 4.0
        first, second, half_x, half_y, bend = JAWS[self.jaws]
        half_x, half_y = ((a * size, b * size) for a, b in (half_x, half_y))
        flat = self.jaws in ("scissors",)  # blades side by side; others lie on each other
        jaws = []
        for length, side in ((first, 1), (second, -1)):
            shift_x, shift_y = (side * half_x[0], side * 0.1) if flat else (0.0, side * half_y[0])
            jaws.append(
                Blade(length * size, 2.0 * size, half_x, half_y, shift_x, shift_y, bend * size, 0.0, 0.25 * size)
            )
        color, metal = FINISHES[self.finish]
        head = (0.62, 0.60, 0.56) if self.finish != "blue" else (0.45, 0.46, 0.48)
        materials = (_material(color, metal, self.gloss), *(_material(head, True, self.gloss),) * 2)
        common: dict[str, Any] = {
            "name": "instrument",
            "radius": self.radius,
            "wrist_radius": 0.8 * self.radius,
            "prong_half_x": (0.45 * self.radius, 0.68 * self.radius),
            "prong_half_y": 0.6 * self.radius,
            "pin": 0.28 * self.radius,
            "jaws": tuple(jaws),
            "shares": (self.moving_jaws, 1 - self.moving_jaws),
            "materials": materials,
            "mirrors": self.gloss > 0.6,
            "rings": self.rings,
        }
        if self.kind == "wrist":
            return WristedDesign(hinge=2.6 * self.radius, collar=1.0 * self.radius, pitch_at=0.4 * self.radius,
                                 ball=0.85 * self.radius, **common)  # fmt: skip
        return Design(hinge=3.0 * self.radius, collar=2.2 * self.radius, **common)


def draw_world(seed: int, *, touched: bool = False) -> World:
    """The world of a seed; touched: its instrument touches the tissue, all else is the same."""
    rng = np.random.default_rng((seed, 11))

    def one_of(choices: Any, shares: Any = None) -> Any:
        names = list(choices)
        return names[int(rng.choice(len(names), p=shares))]

    kind = one_of(KINDS, (0.15, 0.40, 0.45))
    count = int(rng.integers(1, 4))
    lamps = tuple(_lamp(rng) for _ in range(count))
    states = one_of(STATES, (0.25, 0.30, 0.20, 0.25))
    world = World(
        seed=seed,
        size=one_of(SIZES, (0.4, 0.3, 0.2, 0.1)),
        kind=kind,
        radius=float(rng.uniform(2.4, 4.4)),
        finish=one_of(FINISHES, (0.36, 0.18, 0.20, 0.12, 0.14)),
        gloss=float(rng.uniform(0, 1)),
        rings=bool(rng.random() < 0.25),
        jaws=one_of(JAWS),
        moving_jaws=float(one_of((1.0, 0.5, 0.64))),
        background=one_of(BACKGROUNDS),
        texture=float(rng.uniform(0.3, 1.3)),
        wet=bool(rng.random() < 0.7),
        lamps=lamps,
        shadow_sharpness=float(rng.uniform(8, 28)),
        contact=float(one_of((0.0, 5.0))),
        exposure=float(np.exp(rng.uniform(math.log(0.6), math.log(1.5)))),
        balance=tuple(np.exp(rng.uniform(-0.12, 0.12, 3)).tolist()),
        automatic=bool(rng.random() < 0.25),
        focal=float(rng.uniform(0.85, 1.25)),
        noise=float(rng.uniform(0.4, 2.5)),
        blur=float(rng.uniform(0.0, 0.9)),
        scope=one_of(SCOPES, (0.45, 0.35, 0.20)),
        frames=one_of(TRAIN_FRAMES, (0.15, 0.25, 0.22, 0.20, 0.12, 0.06)),
        coverage=float(rng.uniform(0.35, 1.0)),
        roll=float(rng.uniform(12, 60)) * DEGREE,
        depth=float(rng.uniform(34, 62)),
        aside=(float(rng.uniform(-14, 14)), float(rng.uniform(-12, 12))),
        azimuth=float(rng.uniform(-math.pi, math.pi)),
        states=states,
        error_scale=float(rng.uniform(0.4, 1.2)),
        wrong=float(one_of((0.0, 0.05, 0.10), (0.6, 0.2, 0.2))) if states != "exact" else 0.0,
        links=one_of(LINKS, (0.4, 0.35, 0.25)) if kind != "straight" else "none",
        joints=kind != "straight" and bool(rng.random() < 0.88),
        stated=states == "independent" and bool(rng.random() < 0.4),
        scale=float(one_of((1.0, 0.5, 0.75), (0.8, 0.1, 0.1))),
        base=float(one_of((1.0, 4.0))) if states == "encoders" else 0.0,
        frame_off=0.0,
    )
    if world.links == "off":
        world = replace(world, frame_off=float(one_of((0.0, -8.0, 8.0))))
    return replace(world, touch=draw_touch(seed, kind != "straight")) if touched else world


def recoloured(tissue: Tissue, color: Triple, contrast: float, wet: float) -> Tissue:
    """The tissue with another mean colour (linear), so many times its contrast, and a share of its wet highlights."""
    surface = tissue.surface.clone()
    albedo = surface[:3]
    mean = albedo.mean((1, 2), keepdim=True)
    varied = torch.tensor(color)[:, None, None] * (1 + contrast * (albedo / mean - 1))
    surface[:3] = varied.clamp(0.004, 0.95)
    surface[6] *= wet
    return replace(tissue, surface=surface)


def _material(color: Triple, metal: bool, gloss: float) -> Material:
    """A surface from matt (gloss 0) to mirror-like metal or polished plastic (1)."""
    diffuse = 1.0 - gloss * (0.92 if metal else 0.15)
    shine = 0.04 + gloss**2 * (2.2 if metal else 0.5)
    return Material(color, diffuse, shine, 12.0 + 140.0 * gloss**2)


def _lamp(rng: np.random.Generator) -> Triple:
    """A lamp 2 to 16 mm from the lens, to any side."""
    away, towards = float(rng.uniform(2, 16)), float(rng.uniform(-math.pi, math.pi))
    return away * math.cos(towards), away * math.sin(towards), 0.0


def _scaled(factor: float) -> dict[str, float]:
    """Sizes of a tracker's errors, `factor` times the usual ones; those of the reconstruction stay."""
    usual = asdict(ErrorModel())
    names = ("drift_mm", "white_mm", "drift_rad", "white_rad", "jaw_drift_rad", "jaw_white_rad")
    return {name: factor * usual[name] for name in names}
