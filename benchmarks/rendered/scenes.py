"""The scenes: what each organ, instrument, motion, sensor and reading is. Angles in rad, lengths in mm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendered.errors import EXACT, ErrorModel
from rendered.instrument import Blade, Design, Material
from rendered.motion import Array, Path, look, rigid
from rendered.render import Lamps
from rendered.wristed import Encoders, WristedDesign


@dataclass(frozen=True)
class Mount:
    """How the tracked sensor sits on the shaft."""

    position: tuple[float, float, float]  # mechanical frame
    spin: float  # about the shaft
    tilt: float  # of the sensor's z against the shaft
    tilt_towards: float

    def mechanical_from_sensor(self) -> Array:
        """[4, 4]."""
        lean = Rotation.from_rotvec(self.tilt * np.array([math.cos(self.tilt_towards), math.sin(self.tilt_towards), 0]))
        spin = Rotation.from_rotvec([0, 0, self.spin])
        return rigid((lean * spin).as_matrix(), np.array(self.position))


@dataclass(frozen=True)
class Joint:
    """What the jaw's sensor says: `zero + sign * opening`."""

    zero: float
    sign: int
    limits: tuple[float, float]  # of the reading

    def reading(self, opening: float) -> float:
        """The reading at an opening (angle between the jaws)."""
        return self.zero + self.sign * opening


@dataclass(frozen=True)
class SceneSpec:
    """Everything about one scene."""

    organ: str
    design: Design
    lamps: Lamps
    path: Path
    mount: Mount
    joint: Joint
    seed: int
    world_turn: tuple[float, float, float]  # the tracker's world against the scene: rotation vector …
    world_shift: tuple[float, float, float]  # … and shift
    errors: ErrorModel = field(default_factory=ErrorModel)
    encoders: Encoders | None = None  # of the wrist, where there is one

    def with_still_camera(self) -> SceneSpec:
        """The same scene before a scope that stands still in the middle of its path: the world is its frame, and
        nothing about it is off."""
        still = replace(self.path, camera_sway=(0.0, 0.0, 0.0), look_sway=(0.0, 0.0))
        pose = look(np.array(still.camera_center), np.array(still.look_at), still.camera_roll)
        exact = replace(self.errors, scale=1.0, back_mm=0.0, aside_mm=0.0, turn_rad=0.0)
        exact = replace(exact, camera_jitter_mm=0.0, camera_jitter_rad=0.0)
        turn = Rotation.from_matrix(pose[:3, :3].T).as_rotvec()
        shift = -pose[:3, :3].T @ pose[:3, 3]
        return replace(
            self, path=still, errors=exact, world_turn=tuple(turn.tolist()), world_shift=tuple(shift.tolist())
        )

    def without_errors(self) -> SceneSpec:
        """The same scene, its cameras, poses and readings exact."""
        return replace(self, errors=EXACT)

    def world_from_scene(self) -> Array:
        """[4, 4]."""
        return rigid(Rotation.from_rotvec(self.world_turn).as_matrix(), np.array(self.world_shift))


DEGREE = math.pi / 180

SCISSORS = Design(
    name="scissors",
    radius=2.5,
    hinge=10.5,
    collar=7.0,
    wrist_radius=2.35,
    prong_half_x=(1.35, 2.2),
    prong_half_y=1.9,
    pin=1.0,
    jaws=(
        Blade(23.0, 2.0, (0.55, 0.30), (1.75, 0.55), 0.58, 0.1, 5.0, 0.0, 0.2),
        Blade(22.0, 2.0, (0.55, 0.30), (1.55, 0.50), -0.58, -0.1, 5.0, 0.0, 0.2),
    ),
    shares=(0.64, 0.36),
    materials=(
        Material((0.022, 0.023, 0.026), 1.0, 0.10, 22.0),
        Material((0.80, 0.50, 0.15), 0.50, 0.50, 35.0),
        Material((0.52, 0.54, 0.57), 0.42, 0.60, 45.0),
    ),
)

GRASPER = Design(
    name="grasper",
    radius=4.0,
    hinge=14.0,
    collar=10.5,
    wrist_radius=3.8,
    prong_half_x=(2.45, 3.5),
    prong_half_y=2.9,
    pin=1.5,
    jaws=(
        Blade(15.0, 2.4, (2.3, 1.8), (1.95, 1.3), 0.0, 1.95, 0.0, 0.5, 0.6),
        Blade(15.5, 2.4, (2.3, 1.8), (1.85, 1.3), 0.0, -1.85, 0.0, -0.4, 0.6),
    ),
    shares=(1.0, 0.0),
    materials=(
        Material((0.17, 0.175, 0.19), 0.9, 0.14, 18.0),
        Material((0.36, 0.38, 0.44), 0.50, 0.35, 30.0),
        Material((0.60, 0.58, 0.54), 0.48, 0.40, 28.0),
    ),
)

SCENES = {
    "bowel": SceneSpec(
        organ="bowel",
        design=SCISSORS,
        lamps=Lamps(((-4.0, -3.0, 0.0), (4.0, -3.0, 0.0)), power=1.25, distance=95.0, focus=2.0),
        path=Path(
            camera_center=(-8.0, -28.0, 112.0),
            camera_sway=(12.0, 9.0, 15.0),
            look_at=(0.0, -2.0, 5.0),
            look_sway=(6.0, 6.0),
            camera_roll=0.12,
            trocar=(-118.0, 42.0, 128.0),
            hinge_center=(0.0, -9.0, 50.0),
            hinge_sway=(11.0, 10.0, 8.0),
            hinge_extra=(9.0, 12.0, -14.0),
            opening_train=48 * DEGREE,
            opening_most=74 * DEGREE,
            roll_middle=70 * DEGREE,
            roll_train=55 * DEGREE,
            roll_most=95 * DEGREE,
        ),
        mount=Mount((2.9, -2.2, -26.0), spin=2.45, tilt=9 * DEGREE, tilt_towards=0.7),
        joint=Joint(zero=0.22, sign=1, limits=(0.2, 1.7)),
        seed=11,
        world_turn=(0.9, -1.4, 0.5),
        world_shift=(-85.0, 140.0, 310.0),
    ),
    "stomach": SceneSpec(
        organ="stomach",
        design=GRASPER,
        lamps=Lamps(((0.0, -5.0, 0.0), (-4.0, 3.0, 0.0), (4.0, 3.0, 0.0)), power=1.30, distance=80.0, focus=3.0),
        path=Path(
            camera_center=(14.0, -8.0, 98.0),
            camera_sway=(10.0, 13.0, 10.0),
            look_at=(6.0, 4.0, 6.0),
            look_sway=(7.0, 5.0),
            camera_roll=-0.5,
            trocar=(96.0, 88.0, 135.0),
            hinge_center=(8.0, 0.0, 46.0),
            hinge_sway=(12.0, 9.0, 6.0),
            hinge_extra=(-10.0, -8.0, -6.0),
            opening_train=32 * DEGREE,
            opening_most=50 * DEGREE,
            roll_middle=-40 * DEGREE,
            roll_train=45 * DEGREE,
            roll_most=80 * DEGREE,
        ),
        mount=Mount((-4.2, 1.6, -9.0), spin=-0.95, tilt=16 * DEGREE, tilt_towards=2.5),
        joint=Joint(zero=0.0, sign=-1, limits=(-1.0, 0.05)),
        seed=23,
        world_turn=(-2.1, 0.3, 1.1),
        world_shift=(60.0, -35.0, -190.0),
    ),
}

# The organs under an instrument with a wrist, as robots carry: pitch, then 9 mm further yaw and two unequal jaws.
NEEDLE_DRIVER = WristedDesign(
    name="needle_driver",
    radius=4.0,
    pitch_at=1.5,
    ball=3.4,
    hinge=10.5,
    collar=4.0,
    wrist_radius=3.1,
    prong_half_x=(1.7, 2.7),
    prong_half_y=2.4,
    pin=1.1,
    jaws=(
        Blade(11.0, 1.6, (1.5, 1.1), (1.45, 0.9), 0.0, 1.45, 0.0, 0.3, 0.4),
        Blade(10.0, 1.6, (1.5, 1.2), (1.35, 0.9), 0.0, -1.35, 0.0, -0.2, 0.4),
    ),
    shares=(0.5, 0.5),
    materials=(
        Material((0.030, 0.031, 0.034), 1.0, 0.12, 20.0),
        Material((0.40, 0.41, 0.44), 0.48, 0.40, 30.0),
        Material((0.62, 0.58, 0.48), 0.46, 0.45, 30.0),
    ),
)

SCENES |= {
    f"{organ}-wristed": replace(
        SCENES[organ],
        design=NEEDLE_DRIVER,
        path=replace(
            SCENES[organ].path,
            hinge_center=tuple(np.add(SCENES[organ].path.hinge_center, (0.0, 0.0, 7.0)).tolist()),
            opening_train=50 * DEGREE,
            opening_most=75 * DEGREE,
            wrist_train=(40 * DEGREE, 35 * DEGREE),
            wrist_most=(58 * DEGREE, 52 * DEGREE),
        ),
        joint=Joint(zero=0.0, sign=1, limits=(-0.1, 1.5)),
        encoders=encoders,
        seed=seed,
    )
    for organ, seed, encoders in (
        ("bowel", 71, Encoders((1.6 * DEGREE, -1.1 * DEGREE), 0.8 * DEGREE, 0.3 * DEGREE)),
        ("stomach", 83, Encoders((-1.2 * DEGREE, 1.9 * DEGREE), 0.6 * DEGREE, 0.3 * DEGREE)),
    )
}
# The same on a bench: a black shaft and bare steel over surgical cloth, lamps beside the lens that cast two shadows.
SCENES["cloth-wristed"] = replace(
    SCENES["bowel-wristed"],
    organ="cloth",
    design=replace(
        NEEDLE_DRIVER,
        mirrors=True,
        materials=(
            Material((0.008, 0.008, 0.009), 1.0, 0.04, 14.0),
            Material((0.72, 0.72, 0.74), 0.06, 2.5, 160.0),
            Material((0.76, 0.75, 0.72), 0.08, 2.0, 120.0),
        ),
    ),
    lamps=Lamps(
        ((-13.0, 0.0, 0.0), (13.0, 0.0, 0.0)), power=1.5, distance=105.0, focus=1.5, sharpness=28.0, contact=5.0
    ),
    path=replace(
        SCENES["bowel-wristed"].path,
        trocar=(-62.0, 118.0, 112.0),
        hinge_center=(2.0, -4.0, 34.0),
        hinge_sway=(15.0, 11.0, 6.0),
        hinge_extra=(9.0, 12.0, 10.0),
        roll_middle=-20 * DEGREE,
    ),
    encoders=Encoders((1.3 * DEGREE, -1.7 * DEGREE), 0.8 * DEGREE, 0.3 * DEGREE),
    seed=113,
    world_turn=(0.3, 0.7, -1.2),
    world_shift=(25.0, -60.0, 150.0),
)
