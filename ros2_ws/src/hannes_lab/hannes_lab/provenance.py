"""What a fitted model was made from: it stands in its file."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hannes_description.model import Model

from .diagnosis import ERROR_UNIT, Fall
from .features import Features, data_used


def made_from(model: Model, nominal: Model, features: Features, **more: Any) -> Model:
    """The model with the recordings (and their hashes) and the nominal model that it was made from, and what else is
    said."""
    bags = [{k: d[k] for k in ("source", "sha256", "closures")} for d in data_used(features)]
    made = {"bags": bags, "nominal_sha256": nominal.sha256, "error_unit": ERROR_UNIT}
    return replace(model, provenance={**model.provenance, **made, **more})


def falls_made(falls: Sequence[Fall]) -> list[dict[str, Any]]:
    """How the error fell, in few digits; what is not known is left out."""
    return [
        {"added": f.added}
        | {k: round(v, 4) for k, v in (("train", f.train), ("held_out", f.held_out)) if math.isfinite(v)}
        for f in falls
    ]


def own_command() -> str:
    """The command of this process, as a shell takes it."""
    return shlex.join(["hannes", *sys.argv[1:]])


def save_model(model: Model, path: Path, command: str) -> None:
    """Write a model file, named as the file, with the command that made it."""
    replace(model, name=path.stem, provenance={**model.provenance, "command": command}).save(path)
