"""What finds instruments and joints for a method's hooks, around one training session."""

from __future__ import annotations

from dataclasses import dataclass

from neeco.scene.hinges import Hinged
from neeco.scene.swept import SweptVolume
from neeco.training.instruments.discovery import find_instruments
from neeco.training.instruments.finish import conclude
from neeco.training.instruments.gate import close_gate
from neeco.training.instruments.light import find_shadow
from neeco.training.instruments.wrist import place_wrists, replace_wrists
from neeco.training.session import GaussianSession


@dataclass(frozen=True)
class SessionSearch:
    """`neeco.scene.learning.InstrumentSearch` in the views of `session`."""

    session: GaussianSession

    def find(self, hinged: Hinged) -> None:
        """See `find_instruments`."""
        find_instruments(self.session, hinged)

    def bound(self, volume: SweptVolume) -> None:
        """See `close_gate`."""
        close_gate(self.session, volume)

    def place_wrists(self, hinged: Hinged) -> None:
        """See `neeco.training.instruments.wrist`."""
        place_wrists(self.session, hinged)

    def replace_wrists(self, hinged: Hinged) -> None:
        """See `neeco.training.instruments.wrist`."""
        replace_wrists(self.session, hinged)

    def find_shadow(self) -> None:
        """See `neeco.training.instruments.light`."""
        find_shadow(self.session)

    def conclude(self, hinged: Hinged) -> None:
        """See `neeco.training.instruments.finish`."""
        conclude(self.session, hinged)
