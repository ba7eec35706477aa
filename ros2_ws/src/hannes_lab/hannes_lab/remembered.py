"""Residuals of simulations kept in a folder under the hash of all that determines them: a stopped fit goes on."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from numpy.typing import NDArray

from .search import Progress

Array = NDArray[np.float64]


class Remembered:
    """A problem whose residuals are kept in a folder, content-addressed; `folder` None keeps nothing."""

    def __init__(self, problem: Any, key: str, folder: Path | None, progress: Progress | None = None) -> None:
        self.problem, self.key, self.folder = problem, key, folder
        self.hits = 0
        self.done = 0
        self.failures = 0
        self._progress = progress
        self.total, self.text = 1, "simulation"
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise HannesError(
                    f"Cannot use the cache folder '{folder}': {error}; give another --cache."
                ) from error

    @property
    def features(self) -> Any:
        return self.problem.features

    def residual(self, model: Model, values: Mapping[str, float]) -> Array:
        """The residual, from the folder where it is there; what diverged is counted in `failures` either way."""
        out = self._residual(model, values)
        self.failures += bool(np.all(out == self.problem.failed))
        return out

    def _residual(self, model: Model, values: Mapping[str, float]) -> Array:
        self.done += 1
        if self._progress is not None:
            self._progress(self.done, max(self.total, self.done), self.text)
        if self.folder is None:
            return np.asarray(self.problem.residual(model, values), dtype=np.float64)
        text = self.key + model.sha256 + json.dumps(sorted((k, float(v)) for k, v in values.items()))
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()}.f8"
        if path.exists():
            try:
                kept = np.fromfile(path, dtype="<f8")
                if kept.shape == (self.problem.features.size,):
                    self.hits += 1
                    return np.asarray(kept, dtype=np.float64)
            except (OSError, ValueError):
                path.unlink(missing_ok=True)  # cut off while it was written; it is made again
        out = np.asarray(self.problem.residual(model, values), dtype=np.float64)
        part = path.with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as file:
            out.astype("<f8").tofile(file)
        part.replace(path)
        return out
