"""What a scene was learned from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from neeco.capture.model import Camera, Frame, Instrument, InstrumentState, State


@dataclass(frozen=True)
class Recorded:
    """Every training frame's name, split, state and camera."""

    names: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    states: tuple[State, ...] = ()
    cameras: tuple[Camera, ...] = ()

    @classmethod
    def of(cls, frames: Sequence[Frame], instruments: tuple[Instrument, ...]) -> Recorded:
        """What `frames` say of `instruments`: only these, and of each only the joints named."""
        return cls(
            tuple(frame.name for frame in frames),
            tuple(frame.split for frame in frames),
            tuple(_reduced(frame.state, instruments) for frame in frames),
            tuple(frame.camera for frame in frames),
        )


def _reduced(state: State, instruments: tuple[Instrument, ...]) -> State:
    kept = {}
    for instrument in instruments:
        given = state.instruments[instrument.name]
        kept[instrument.name] = InstrumentState(given.pose, {joint: given.joints[joint] for joint in instrument.joints})
    return State(kept, state.time)
