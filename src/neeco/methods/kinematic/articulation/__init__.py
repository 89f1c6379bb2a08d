"""How instruments are articulated: a shaft, and the links that joints move."""

from neeco.capture.model import Instrument
from neeco.methods.kinematic.articulation.base import (
    LABEL_SHARE,
    LINK_LOGITS,
    ArticulatedInstruments,
    Articulation,
)
from neeco.methods.kinematic.articulation.hinges import Hinges
from neeco.methods.kinematic.articulation.stated import StatedLinks

__all__ = [
    "LABEL_SHARE",
    "LINK_LOGITS",
    "ArticulatedInstruments",
    "Articulation",
    "articulation_of",
]


def articulation_of(instrument: Instrument) -> Articulation:
    """As its kinematics state, where they do; else a shaft with a hinge per joint, to be found from the images."""
    tree = instrument.kinematics
    return StatedLinks(tree) if tree is not None and tree.readings else Hinges(tuple(instrument.joints))
