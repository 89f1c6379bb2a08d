"""Options that several verbs have, said once."""

from __future__ import annotations

from typing import Annotated

import tyro

Device = Annotated[str, tyro.conf.arg(help="cpu, cuda, cuda:N, or auto: a CUDA device where there is one.")]
