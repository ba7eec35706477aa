"""Residuals of simulations kept in a store under the hash of all that determines them: a stopped fit goes on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from numpy.typing import NDArray

from .cache import Store
from .search import Progress

Array = NDArray[np.float64]


class Remembered:
    """A problem whose residuals are kept in a folder, content-addressed; `folder` None keeps nothing."""

    def __init__(self, problem: Any, key: str, folder: Path | None, progress: Progress | None = None) -> None:
        self.problem, self.key = problem, key
        self.done = 0
        self.failures = 0
        self._progress = progress
        self.total, self.text = 1, "simulation"
        self._store: Store | None = None
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise HannesError(
                    f"Cannot use the cache folder '{folder}': {error}; give another --cache."
                ) from error
            self._store = Store(folder)

    @property
    def hits(self) -> int:
        """Residuals that were in the folder."""
        return self._store.hits if self._store else 0

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
        text = self.key + model.sha256 + json.dumps(sorted((k, float(v)) for k, v in values.items()))
        key = hashlib.sha256(text.encode()).hexdigest()
        kept = self._store.read(key) if self._store else None
        if kept is not None:
            return np.asarray(kept, dtype=np.float64)
        out = np.asarray(self.problem.residual(model, values), dtype=np.float64)
        if self._store:
            self._store.write(key, out)
        return out
