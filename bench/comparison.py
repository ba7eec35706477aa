"""The lab beside what the field does today, on the same sets: `python bench/comparison.py [--jobs N]`.

Each set is made by `hide` (hand of the population, scatter, the thesis' sensors) with a hidden effect; every method
gets the recordings only, learns from every second closure, and is judged by the closed-loop error on the others, in
multiples of the repeatability between closures.

    nominal      the model as it is
    parameters   its uncertain parameters by least squares (scipy), no structure
    sysid        the same parameters by mujoco.sysid on the same residual; skipped without `mujoco[sysid]`
    sindy        torque residual by inverse dynamics from encoder and current, sparse regression on it by pysindy, and
                 the terms put back into the simulation; skipped without pysindy
    lab          `diagnose`

Every result is kept in a file named by its content and the sources' hash: an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import inspect
import io
import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_lab.cache import code_hash
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.errors import overall, repeatability, signal_errors, split_closures
from hannes_lab.features import Features
from hannes_lab.fit import fit
from hannes_lab.hand import HAND_ZERO
from hannes_lab.hide import make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import Problem, nuisance_coordinate, values_at
from hannes_lab.recorded import make_trial
from hannes_lab.rig import Nuisance
from hannes_sim.effect import load_effect
from joblib import Parallel, delayed
from numpy.typing import NDArray

Array = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
OUTSIDE = HERE / "outside_effects.py"
TERMS = f"{HERE / 'sparse_terms.py'}:SparseTerms"

SETS: tuple[tuple[str, str | None, float], ...] = (
    ("nothing", None, 0.0),
    ("viscous friction", "viscous_friction", 2.0),
    ("Coulomb friction", "coulomb_friction", 2.0),
    ("glove", "glove_stiffness", 1.0),
    ("current sensor gain", "current_sensor", 1.0),
    ("load-dependent friction", "load_dependent_friction", 1.0),
    ("wire slack", "wire_slack", 1.0),
    ("backlash", "gear_backlash", 1.0),
    ("outside: a latch", f"{OUTSIDE}:Latch", 1.0),
)
"""What is hidden: label, effect, strength in typical values."""

METHODS = ("nominal", "parameters", "sysid", "sindy", "lab")
FIRST_SEED = 61_001


@dataclass(frozen=True)
class Case:
    """One set with one method."""

    label: str
    effect: str | None
    factor: float
    seed: int
    method: str
    closures: int = 12

    @property
    def key(self) -> str:
        used = (FUNCTIONS[self.method], data, plain_problem, judged, _moved, _sparse, Case.entries)
        sources = "".join(inspect.getsource(f) for f in used)
        sources += OUTSIDE.read_text() + (HERE / "sparse_terms.py").read_text()
        text = json.dumps([asdict(self), code_hash(), sources], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:20]

    def entries(self) -> list[EffectEntry]:
        if self.effect is None:
            return []
        kind = load_effect(self.effect)
        values = {
            p.name: min(p.typical * (self.factor if p.vanishing is not None else 1.0), p.upper)
            for p in kind.parameters
        }
        return [kind.entry(values, source=self.effect if ":" in self.effect else None)]


def missing(method: str) -> str | None:
    """Why a method cannot run here."""
    if method == "sindy" and importlib.util.find_spec("pysindy") is None:
        return "pysindy is not installed (requirements/bench.txt)"
    if method == "sysid":
        import mujoco.sysid

        if not hasattr(mujoco.sysid, "optimize"):
            return "mujoco.sysid lacks its libraries: pip install 'mujoco[sysid]'"
    return None


# -- the data ---------------------------------------------------------------------------------------------------------
def data(case: Case) -> Prepared:
    model = Model.load()
    recordings, _ = make_set(model, case.entries(), seed=case.seed, closures=case.closures)
    return prepare([make_trial(r) for r in recordings], model)


def plain_problem(prepared: Prepared, features: Features) -> Problem:
    """Least squares as it is usually set up: every signal divided by its standard deviation, no noise model."""
    rows = [np.arange(s.start, s.stop) for s in features.slices]
    whitener = tuple(
        (own, np.eye(own.size) * float(np.std(block.measured)))
        for own, block in zip(rows, features.blocks, strict=True)
    )
    return Problem(
        prepared.rig, features, whitener, tuple(np.zeros_like(b.measured) for b in features.blocks)
    )


def judged(prepared: Prepared, model: Model, values: dict[str, float]) -> float:
    """Error on the held-out closures."""
    _, test = split_closures(prepared.features)
    floor = [repeatability(block) for block in prepared.features.blocks]
    return overall(signal_errors(test, test.closures(prepared.rig, model, values), floor))


def shared_out(prepared: Prepared) -> list[Nuisance]:
    """The uncertain parameters without the zero that recordings share: priors alone tell it from that of each."""
    return [n for n in prepared.nuisances if n.name != HAND_ZERO]


# -- the methods ------------------------------------------------------------------------------------------------------
def nominal(prepared: Prepared) -> dict[str, Any]:
    return {"error": judged(prepared, prepared.model, {}), "names": "-"}


def parameters(prepared: Prepared) -> dict[str, Any]:
    """All uncertain parameters by scipy's least squares, without priors."""
    train, _ = split_closures(prepared.features)
    coordinates = [replace(nuisance_coordinate(n), prior=False) for n in shared_out(prepared)]
    found = fit(plain_problem(prepared, train), prepared.model, coordinates, {}, evaluations=60)
    return {"error": judged(prepared, prepared.model, found.values), "names": _moved(found.z, prepared)}


def sysid(prepared: Prepared) -> dict[str, Any]:
    """The same parameters by mujoco.sysid's optimiser."""
    from mujoco import sysid as toolbox

    train, _ = split_closures(prepared.features)
    problem = plain_problem(prepared, train)
    coordinates = [nuisance_coordinate(n) for n in shared_out(prepared)]
    wanted = toolbox.ParameterDict({
        c.name: toolbox.Parameter(c.name, nominal=0.0, min_value=-30.0, max_value=30.0) for c in coordinates
    })  # fmt: skip

    def residual(x: Array, _: Any) -> tuple[list[Array], list[Any], list[Any]]:
        columns = []
        for point in np.reshape(x, (len(coordinates), -1)).T:  # one column per point of a Jacobian
            columns.append(problem.residual(prepared.model, values_at(coordinates, point)))
        return [np.column_stack(columns) if np.ndim(x) > 1 else columns[0]], [], []

    # finite differences as large as the lab's own: smaller ones see the roughness of dry friction
    with contextlib.redirect_stdout(io.StringIO()):  # its log of the iterations
        found, _ = toolbox.optimize(
            wanted, residual, optimizer="mujoco", verbose=False, max_iters=60, eps=0.5
        )
    z = np.asarray(found.as_vector(), dtype=np.float64)
    values = values_at(coordinates, z)
    return {"error": judged(prepared, prepared.model, values), "names": _moved(z, prepared)}


def _moved(z: Array, prepared: Prepared) -> str:
    """The model's own parameters that moved most, if by more than two standard deviations of what is usual."""
    far = sorted(zip(np.abs(z), shared_out(prepared), strict=True), key=lambda item: -item[0])
    names = [n.name for size, n in far if size > 2.0 and "@" not in n.name]
    return "moves " + ", ".join(names[:3]) if names else "-"


def sindy(prepared: Prepared) -> dict[str, Any]:
    """Sparse regression on the torque residual, its threshold by held-out closures of the training part."""
    import pysindy
    from sparse_terms import NAMES, TITLES, SparseTerms, regression

    theta, residual, groups = regression(prepared, training=True)
    scale = np.sqrt((theta**2).mean(axis=0)) + 1e-12
    tried: list[tuple[float, float, Array]] = []
    for threshold in np.geomspace(0.02, 1.0, 15) * float(np.std(residual)):
        errors = []
        for group in np.unique(groups):
            inside = groups != group
            c = _sparse(pysindy, theta[inside] / scale, residual[inside], threshold)
            errors.append(float(np.mean((residual[~inside] - theta[~inside] / scale @ c) ** 2)))
        sd = float(np.std(errors, ddof=1) / np.sqrt(len(errors)))
        tried.append(
            (float(np.mean(errors)), sd, _sparse(pysindy, theta / scale, residual, threshold) / scale)
        )
    # the sparsest whose error is within one standard error of the least (Hastie, Tibshirani, Friedman 2009, 7.10)
    least = min(tried, key=lambda one: one[0])
    found = [c for error, _, c in tried if error <= least[0] + least[1]][-1]
    kind = SparseTerms
    bounds = {p.name: (p.lower, p.upper) for p in kind.parameters}
    values = {n: float(np.clip(c, *bounds[n])) for n, c in zip(NAMES, found, strict=True)}
    model = prepared.model.with_effect(kind.entry(values, source=TERMS))
    terms = [f"{c:+.2g} {TITLES[n]}" for n, c in zip(NAMES, found, strict=True) if c != 0.0]
    return {"error": judged(prepared, model, {}), "names": " ".join(terms) or "-"}


def _sparse(pysindy: Any, theta: Array, residual: Array, threshold: float) -> Array:
    optimizer = pysindy.STLSQ(threshold=float(threshold), alpha=1e-6)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a threshold leaves no term
        optimizer.fit(theta, residual[:, None])
    return np.asarray(optimizer.coef_, dtype=np.float64).ravel()


def lab(prepared: Prepared) -> dict[str, Any]:
    found = diagnose(prepared, effect_sources(model=prepared.model))
    names = " or ".join(" + ".join(t) for t in found.tied) or " + ".join(e.name for e in found.effects)
    told = found.verdict if found.verdict != "effects" else names
    return {"error": found.falls[-1].held_out, "names": told}


FUNCTIONS: dict[str, Callable[[Prepared], dict[str, Any]]] = {
    "nominal": nominal, "parameters": parameters, "sysid": sysid, "sindy": sindy, "lab": lab,
}  # fmt: skip


# -- the bench --------------------------------------------------------------------------------------------------------
def kept(case: Case, file: Path) -> dict[str, Any]:
    sys.path.insert(0, str(HERE))
    start = time.monotonic()
    result = FUNCTIONS[case.method](data(case)) | asdict(case) | {"seconds": time.monotonic() - start}
    temporary = file.with_suffix(".tmp")
    temporary.write_text(json.dumps(result))
    temporary.replace(file)
    return result


def table(results: list[dict[str, Any]], methods: list[str]) -> str:
    """Markdown: one row per set and seed; error, and what is named."""
    by = {(r["label"], r["seed"], r["method"]): r for r in results}
    lines = ["| hidden | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for label, seed in dict.fromkeys((r["label"], r["seed"]) for r in results):
        row = [by[(label, seed, m)] for m in methods]
        cells = [f"{r['error']:.2f}" + ("" if r["names"] == "-" else f": {r['names']}") for r in row]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--methods", default=",".join(METHODS), help="which of " + ", ".join(METHODS))
    parser.add_argument("--out", type=Path, default=Path("out/comparison"), help="folder of the kept results")
    parser.add_argument("--seeds", type=int, default=2, help="sets per hidden effect")
    options = parser.parse_args()
    methods = options.methods.split(",")
    if set(methods) - set(METHODS):
        raise HannesError(f"--methods: valid are {', '.join(METHODS)}.")
    for method in list(methods):
        if why := missing(method):
            print(f"{method} is left out: {why}", file=sys.stderr)
            methods.remove(method)
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(FIRST_SEED, FIRST_SEED + options.seeds)
    cases = [Case(*one, seed, method) for seed in seeds for one in SETS for method in methods]
    files = [options.out / f"{case.key}.json" for case in cases]
    todo = [(c, f) for c, f in zip(cases, files, strict=True) if not f.exists()]
    print(f"{len(cases)} results, {len(cases) - len(todo)} kept from before", file=sys.stderr)
    runs = Parallel(n_jobs=options.jobs, return_as="generator_unordered")(
        delayed(kept)(c, f) for c, f in todo
    )
    for k, r in enumerate(runs):
        told = f"{r['label']}, {r['method']}: {r['error']:.2f} {r['names']} ({r['seconds']:.0f} s)"
        print(f"[{k + 1}/{len(todo)}] {told}", file=sys.stderr, flush=True)
    print(table([json.loads(f.read_text()) for f in files], methods))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
