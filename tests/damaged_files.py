"""Damage to the bytes of files, and what reading them then says."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError


def refusals(files: Sequence[Path], reads: Sequence[Callable[[], object]], cases: int) -> list[str]:
    """Messages of readings of files of which one at a time is damaged, each a NeecoError of one line; the files are
    whole again afterwards."""
    messages = []
    for case in range(cases):
        pick = np.random.default_rng(case)
        path = files[case % len(files)]
        whole = path.read_bytes()
        path.write_bytes(_damaged(bytearray(whole), pick))
        for read in reads:
            try:
                read()
            except NeecoError as error:
                messages.append(str(error))
        path.write_bytes(whole)
    assert messages
    folder = str(files[0].parent)
    assert all(len(message.splitlines()) == 1 and folder in message for message in messages)
    return messages


def _damaged(content: bytearray, pick: np.random.Generator) -> bytearray:
    """Cut short, a stretch left out, a length that cannot be, or bytes changed, half of them near the beginning."""
    place = int(pick.integers(len(content)))
    match int(pick.integers(4)):
        case 0:
            return content[:place]
        case 1:
            return content[:place] + content[place + int(pick.integers(200)) :]
        case 2:
            content[place : place + 4] = struct.pack("<I", int(pick.choice([0, 1, 2**31 - 1, 2**32 - 1])))
        case _:
            within = len(content) if pick.random() < 0.5 else min(len(content), 2000)
            for at in pick.integers(0, within, int(pick.choice([1, 3, 30]))):
                content[at] = int(pick.integers(256))
    return content
