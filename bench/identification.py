"""How well the lab finds hidden effects: `python bench/identification.py [--sets ...] [--quick] [--jobs N]`.

Makes measurement sets with `hide` (hand of the population, scatter, the thesis' sensors), diagnoses each blind, and
prints a table of verdicts.  Every case is kept in a file named by its content and the sources' hash, so that an
interrupted run goes on where it stopped.  The seeds differ from those on which thresholds were set.

    nothing   nothing hidden
    single    one effect of the catalogue at 1.5, 2, 3, 5 and 8 times its detection limit
    pairs     two effects at three times their limits
    outside   effects of bench/outside_effects.py
    typical   every effect at its typical strength
    strong    every effect at STRONG times that, or as strong as it may be
    shapes    effects at typical strength whose SHAPES are others than those at which the search starts
    logging   LOGGED at typical strength, with other loggers: 100 Hz, position alone, current alone
    mismatch  made by the MuJoCo plant, fitted by the reduced one
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import EffectEntry, Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.errors import overall, repeatability, signal_errors, split_closures
from hannes_lab.fit import fit
from hannes_lab.hand import HandRig
from hannes_lab.hide import Truth, make_set
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.recorded import make_trial
from hannes_lab.search import Search
from hannes_lab.trials import Trial
from hannes_sim.effect import catalogue, effect_source, load_effect
from joblib import Parallel, delayed

SETS = ("nothing", "single", "pairs", "outside", "typical", "strong", "shapes", "logging", "mismatch")
SHAPES = {
    ("cogging", "period"): (0.6, 1.1, 2.3, 4.2, 9.0, 13.0, 20.0),
    ("stribeck_friction", "velocity"): (0.1, 0.6, 2.0, 10.0),
    ("presliding_friction", "length"): (0.015, 0.2, 1.5),
    ("glove_hysteresis", "relaxation"): (0.05, 1.2, 10.0),
    ("winding_heating", "time_constant"): (4.0, 35.0, 300.0),
    ("velocity_strengthening", "velocity"): (0.1, 0.6, 1.8),
    ("load_dependent_friction", "share"): (0.3, 0.7, 1.0),
}
"""Values of a shape parameter of each effect."""
LOGGED = (
    "viscous_friction",
    "load_dependent_friction",
    "glove_stiffness",
    "wire_slack",
    "gearbox_inertia",
    "command_delay",
    "winding_heating",
    "encoder_eccentricity",
)
LOGGERS = {
    "100 Hz, signed": ("bench", ()),
    "position alone": ("thesis", ("encoder_position",)),
    "current alone": ("thesis", ("motor_current",)),
}
"""Name of the loggers of `hide`, and the signals that take part (all if none are named)."""
FACTORS = (1.5, 2.0, 3.0, 5.0, 8.0)
STRONG = 4.0
JUDGING_SEED = 50_000
"""First seed of the sets that are judged; thresholds are set on seeds below."""

TUNING_SEED = 1_000
"""First seed of the sets on which thresholds are set (up to 31,100)."""

DETECTABLE = 60.0
"""Rise of the cost without it at which an effect counts as detectable: about three times what chance gains."""

WITHIN = 1.15
"""Held-out error, in multiples of the repeatability, up to which an answer explains the data."""

OUTSIDE = Path(__file__).with_name("outside_effects.py")


@dataclass(frozen=True)
class Case:
    """One measurement set: effects as (name or path.py:Class, parameter values)."""

    kind: str
    effects: tuple[tuple[str, tuple[tuple[str, float], ...]], ...]
    factor: float
    seed: int
    closures: int = 13
    sensors: str = "thesis"
    signals: tuple[str, ...] = ()
    made_by: str = "nominal"

    @property
    def key(self) -> str:
        return hashlib.sha256(json.dumps([asdict(self), source_hash()], sort_keys=True).encode()).hexdigest()[
            :20
        ]

    def entries(self) -> list[EffectEntry]:
        out = []
        for name, values in self.effects:
            kind = load_effect(name)
            out.append(kind.entry(dict(values), source=effect_source(name)))
        return out


_HASH: list[str] = []


def source_hash() -> str:
    """Hash of everything that a result depends on."""
    if not _HASH:
        root = Path(__file__).resolve().parents[1] / "ros2_ws" / "src"
        digest = hashlib.sha256()
        for package in ("hannes_description", "hannes_sim", "hannes_control", "hannes_lab"):
            for file in sorted((root / package / package).rglob("*")):
                if file.suffix in (".py", ".yaml") and not file.name.startswith(("report", "pictures")):
                    digest.update(file.read_bytes())
        digest.update(OUTSIDE.read_bytes())
        _HASH.append(digest.hexdigest())
    return _HASH[0]


def run_case(case: Case) -> dict[str, Any]:
    """Make the set, diagnose it blind, and compare with the truth."""
    model = Model.load()
    recordings, truth = make_set(
        Model.load(case.made_by), case.entries(), seed=case.seed, closures=case.closures, sensors=case.sensors
    )
    start = time.monotonic()
    trials = [make_trial(r) for r in recordings]
    prepared = prepare(trials, model, signals=case.signals or None)
    found = diagnose(prepared, effect_sources(model=model))
    seconds = time.monotonic() - start
    hidden = sorted(e.name for e in truth.effects)
    # what comes nearest to something unknown is no answer
    named = sorted(e.name for e in found.effects) if found.verdict == "effects" else []
    inside = []
    if found.verdict == "effects" and named == hidden:
        for effect in truth.effects:
            estimate = next(e for e in found.effects if e.name == effect.name)
            for p in load_effect(effect.source or effect.name).parameters:
                if p.vanishing is not None and effect.values[p.name] != p.vanishing:
                    e = estimate.parameters[p.name]
                    true = effect.values[p.name]
                    inside.append(bool(e.low <= true <= e.high or abs(e.value - true) <= 0.1 * abs(true)))
    return {
        "kind": case.kind,
        "hidden": hidden,
        "factor": case.factor,
        "seed": case.seed,
        "loggers": next(
            (n for n, given in LOGGERS.items() if given == (case.sensors, case.signals)), "30 Hz"
        ),
        "verdict": found.verdict,
        "named": named,
        "tied": [sorted(t) for t in found.tied],
        "inside": inside,
        "costs": dict(found.costs),
        "falls": [[f.added, f.held_out, dict(f.by_condition)] for f in found.falls],
        "final": found.falls[-1].held_out,
        "hidden_hand": error_of_the_hidden(trials, prepared, Model.load(case.made_by), truth),
        "nominal": found.falls[0].held_out,
        "seconds": seconds,
        "simulations": found.simulations,
    }


def error_of_the_hidden(trials: list[Trial], prepared: Prepared, made_by: Model, truth: Truth) -> float:
    """Error of the hidden hand itself on the held-out closures: no answer that is right comes far below it.

    trials  as recorded: what was seen of an object is no nominal value
    """
    model = made_by
    for effect in truth.effects:
        model = model.with_effect(effect)
    values = {}
    for nuisance in HandRig(trials).nuisances(made_by):
        operation, number, *_ = truth.parameters.get(nuisance.name.partition("@")[0], "x 1").split()
        values[nuisance.name] = (
            nuisance.mean * float(number) if operation == "x" else nuisance.mean + float(number)
        )
    _, held_out = split_closures(prepared.features)
    floor = [repeatability(block) for block in prepared.features.blocks]
    return overall(signal_errors(held_out, held_out.closures(prepared.rig, model, values), floor))


def detection_factors(names: list[str], seed: int = 7) -> dict[str, float]:
    """Strength, in typical values, at which each effect is just detectable: the fall of the cost reaches DETECTABLE
    after the nuisance parameters have compensated what they can (refitted, on a set without an effect)."""
    model = Model.load()
    recordings, _ = make_set(model, [], seed=seed)
    prepared: Prepared = prepare([make_trial(r) for r in recordings], model)
    search = Search(prepared.problem, model, prepared.nuisances, effect_sources(only=names))
    base = search.null().fit
    known = {c.name: base.jacobian[:, j] for j, c in enumerate(base.coordinates)}
    out = {}
    for name in names:
        kind = load_effect(name)
        with_effect, _ = search.with_effects((kind.name,))
        factor, top = 1e-3, highest_factor(name)
        while factor < top:
            strengths = {f"{kind.name}.{n}": v for n, v in strength(name, factor)}
            held = replace(prepared.problem, held=strengths)
            found = fit(held, with_effect, base.coordinates, base.z, known=known, evaluations=8)
            if found.cost >= base.cost + DETECTABLE:
                # The way to a parameter that takes all of it over may be longer.
                found = fit(held, with_effect, base.coordinates, found.z, evaluations=12)
            if found.cost >= base.cost + DETECTABLE:
                break
            factor *= 1.25
        out[name] = min(factor, top)
    return out


def detection_limits(folder: Path) -> dict[str, float]:
    """The detection factors of the whole catalogue, from the folder if these sources made them before."""
    file = folder / f"limits-{source_hash()[:20]}.json"
    if not file.exists():
        file.write_text(json.dumps(detection_factors(sorted(catalogue()))))
    limits: dict[str, float] = json.loads(file.read_text())
    return limits


def strength(name: str, factor: float) -> tuple[tuple[str, float], ...]:
    """Parameters of an effect at `factor` times its typical strength; shape parameters stay typical."""
    return tuple(
        (p.name, float(min(max(p.typical * (factor if p.vanishing is not None else 1.0), p.lower), p.upper)))
        for p in load_effect(name).parameters
    )


def highest_factor(name: str) -> float:
    """Largest factor inside the bounds."""
    return min(
        (p.upper / p.typical if p.typical > 0 else np.inf)
        for p in load_effect(name).parameters
        if p.vanishing is not None
    )


def cases(kinds: list[str], limits: dict[str, float], quick: bool, first: int = JUDGING_SEED) -> list[Case]:
    """All sets of the bench; `first` is the first seed."""
    out: list[Case] = []
    names = sorted(catalogue())
    seed = itertools.count(first)
    if "nothing" in kinds:
        out += [Case("nothing", (), 0.0, first + 10_000 + k) for k in range(10 if quick else 100)]
    if "single" in kinds:
        for name in names:
            for factor in FACTORS[2:3] if quick else FACTORS:
                f = min(factor * limits[name], highest_factor(name))
                out.append(Case("single", ((name, strength(name, f)),), factor, next(seed)))
    if "pairs" in kinds:
        rng = np.random.default_rng(first)
        for k in range(6 if quick else 40):
            a, b = rng.choice(len(names), 2, replace=False)
            chosen = [
                (names[i], strength(names[i], min(3.0 * limits[names[i]], highest_factor(names[i]))))
                for i in (int(a), int(b))
            ]
            out.append(Case("pairs", tuple(chosen), 3.0, first + 20_000 + k))
    if "outside" in kinds:
        import outside_effects

        for k, (name, factor) in enumerate(
            itertools.product(outside_effects.NAMES, (1.0,) if quick else (0.5, 1.0, 2.0))
        ):
            source = f"{OUTSIDE}:{name}"
            out.append(Case("outside", ((source, strength(source, factor)),), factor, first + 30_000 + k))
    typical = [(name, strength(name, min(1.0, highest_factor(name)))) for name in names]
    if "typical" in kinds:
        out += [Case("typical", (one,), 1.0, first + 40_000 + k) for k, one in enumerate(typical)]
    if "strong" in kinds:
        strong = [(name, strength(name, min(STRONG, highest_factor(name)))) for name in names]
        out += [Case("strong", (one,), STRONG, first + 80_000 + k) for k, one in enumerate(strong)]
    if "shapes" in kinds:
        different = [(*which, value) for which, values in SHAPES.items() for value in values]
        for k, (name, shape, value) in enumerate(different):
            given = {**dict(strength(name, 1.0)), shape: value}
            out.append(Case("shapes", ((name, tuple(given.items())),), 1.0, first + 70_000 + k))
    if "logging" in kinds:
        for k, (one, (sensors, signals)) in enumerate(
            itertools.product((t for t in typical if t[0] in LOGGED), LOGGERS.values())
        ):
            out.append(Case("logging", (one,), 1.0, first + 50_000 + k, sensors=sensors, signals=signals))
    if "mismatch" in kinds:
        hidden: list[tuple[Any, ...]] = [(), *((t,) for t in typical if t[0] in LOGGED[:4])]
        out += [
            Case("mismatch", effects, 1.0, first + 60_000 + k, made_by="nominal_mujoco")
            for k, effects in enumerate(hidden)
        ]
    return out


def as_hidden(result: dict[str, Any]) -> bool:
    """Nothing where nothing is hidden, else what is hidden, alone or in a tie."""
    if not result["hidden"]:
        return bool(result["verdict"] == "nothing")
    return result["verdict"] == "effects" and result["hidden"] in (result["tied"] or [result["named"]])


def table(results: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    """Rows: what, measured, target."""
    rows: list[tuple[str, str, str]] = []

    def share(part: list[Any], whole: list[Any]) -> str:
        return f"{len(part)} of {len(whole)} ({100.0 * len(part) / len(whole):.0f} %)" if whole else "-"

    def named(part: list[dict[str, Any]]) -> str:
        return share([r for r in part if as_hidden(r)], part)

    nothing = [r for r in results if r["kind"] == "nothing"]
    single = [r for r in results if r["kind"] == "single"]
    pairs = [r for r in results if r["kind"] == "pairs"]
    outside = [r for r in results if r["kind"] == "outside"]
    if nothing:
        rows.append(
            (
                "nothing hidden: false alarms",
                share([r for r in nothing if r["verdict"] != "nothing"], nothing),
                "at most 5 %",
            )
        )
    if single:
        exact = [
            r
            for r in single
            if r["hidden"] in (r["tied"] or [r["named"]])
            and len(r["tied"]) <= 2
            and r["verdict"] == "effects"
        ]
        wrong = [r for r in single if r["verdict"] == "effects" and r["hidden"] not in r["tied"]]
        inside = [i for r in single for i in r["inside"]]
        whole = [r for r in single if r["hidden"] == r["named"]]
        rows.append(("one hidden: the first that is named", share(whole, single), ""))
        rows.append(("one hidden: named, or tied with one other", share(exact, single), "95 %"))
        rows.append(("one hidden: wrong", share(wrong, single), "at most 1 %"))
        rows.append(
            (
                "one hidden: answered nothing",
                share([r for r in single if r["verdict"] == "nothing"], single),
                "",
            )
        )
        rows.append(
            (
                "one hidden: answered unknown",
                share([r for r in single if r["verdict"] == "unknown"], single),
                "",
            )
        )
        rows.append(
            ("parameter in its interval or within 10 %", share([i for i in inside if i], inside), "90 %")
        )
    if pairs:
        both = [r for r in pairs if as_hidden(r)]
        least = [
            r
            for r in pairs
            if set(r["named"]) & set(r["hidden"]) or any(set(t) & set(r["hidden"]) for t in r["tied"])
        ]
        clean = [
            r
            for r in pairs
            if set(r["named"]) <= set(r["hidden"])
            or r["verdict"] == "unknown"
            or any(set(t) <= set(r["hidden"]) for t in r["tied"])
        ]
        rows += [
            ("two hidden: both", share(both, pairs), "75 %"),
            ("two hidden: at least one", share(least, pairs), "100 %"),
            ("two hidden: none wrong", share(clean, pairs), "95 %"),
        ]
    if outside:
        rows.append(
            (
                "outside the catalogue: unknown",
                share([r for r in outside if r["verdict"] == "unknown"], outside),
                "90 %",
            )
        )
    typical = [r for r in results if r["kind"] == "typical"]
    if typical:
        exact = [r for r in typical if r["named"] == r["hidden"]]
        rows.append(("one hidden at typical strength: named exactly", share(exact, typical), ""))
        rows.append(("one hidden at typical strength: named, or in a tie", named(typical), ""))
    strong = [r for r in results if r["kind"] == "strong"]
    if strong:
        rows.append((f"one hidden at {STRONG:.0f} x typical strength: named, or in a tie", named(strong), ""))
    shapes = [r for r in results if r["kind"] == "shapes"]
    if shapes:
        rows.append(("shapes between those of the search: named, or in a tie", named(shapes), ""))
    for loggers in LOGGERS:
        part = [r for r in results if r["kind"] == "logging" and r["loggers"] == loggers]
        if part:
            rows.append((f"{loggers}: named, or in a tie", named(part), ""))
    mismatch = [r for r in results if r["kind"] == "mismatch"]
    if mismatch:
        rows.append(("made by MuJoCo, fitted by the reduced plant: as hidden", named(mismatch), ""))
    added = [r for r in results if r["verdict"] == "effects" and r["kind"] not in ("logging", "mismatch")]
    if added:
        rows.append(
            (
                "held-out error after adding at most 1.15 x repeatability",
                share([r for r in added if r["final"] <= WITHIN], added),
                "90 %",
            )
        )
        rows.append(
            (
                "... the hidden hand itself, with its true parameters",
                share([r for r in added if r["hidden_hand"] <= WITHIN], added),
                "",
            )
        )
    if results:
        rows.append(
            (
                "time of a diagnosis, median / longest",
                f"{np.median([r['seconds'] for r in results]):.0f} s / {max(r['seconds'] for r in results):.0f} s",
                "180 s (MuJoCo plant)",
            )
        )
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", default=",".join(SETS), help="which of " + ", ".join(SETS))
    parser.add_argument("--quick", action="store_true", help="a fifth of the sets or less")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--tuning", action="store_true", help="the seeds on which thresholds are set, not those that judge"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/identification"), help="folder of the kept results"
    )
    parser.add_argument(
        "--part", default="1/1", help="which part of the sets, as K/N: every N-th, from the K-th on"
    )
    parser.add_argument(
        "--list",
        action="store_true",
        help="print every result that is not as hidden, or beyond 1.15 x repeatability",
    )
    options = parser.parse_args()
    kinds = options.sets.split(",")
    if set(kinds) - set(SETS):
        raise HannesError(f"--sets: valid are {', '.join(SETS)}.")
    sys.path.insert(0, str(Path(__file__).parent))
    options.out.mkdir(parents=True, exist_ok=True)
    limits = detection_limits(options.out) if {"single", "pairs"} & set(kinds) else {}
    todo = cases(kinds, limits, options.quick, TUNING_SEED if options.tuning else JUDGING_SEED)
    first, _, step = options.part.partition("/")
    if not (first.isdigit() and step.isdigit() and 1 <= int(first) <= int(step)):
        raise HannesError(f"--part {options.part}: give K/N with 1 <= K <= N, such as 1/2.")
    todo = todo[int(first) - 1 :: int(step)]
    results: list[dict[str, Any]] = []
    missing = []
    for case in todo:
        file = options.out / f"{case.key}.json"
        if file.exists():
            results.append(json.loads(file.read_text()))
        else:
            missing.append((case, file))
    print(f"{len(todo)} sets, {len(results)} kept from before", file=sys.stderr)
    runs = Parallel(n_jobs=options.jobs, return_as="generator_unordered")(
        delayed(kept)(run_case, c, f) for c, f in missing
    )
    for k, result in enumerate(runs):
        results.append(result)
        print(
            f"[{k + 1}/{len(missing)}] {result['kind']} {result['hidden']} -> {result['verdict']} {result['named']} "
            f"({result['seconds']:.0f} s)",
            file=sys.stderr,
            flush=True,
        )
    if options.list:
        for r in results:
            if r["hidden"] != r["named"] or r["final"] > WITHIN:
                print(
                    json.dumps(
                        {
                            k: r[k]
                            for k in (
                                *("kind", "hidden", "factor", "verdict", "named", "tied", "costs", "seed"),
                                *("final", "hidden_hand"),
                            )
                        }
                    )
                )
    for what, measured, target in table(results):
        print(f"{what:<58} {measured:>22}   {target}")
    return 0


def kept(run: Callable[[Any], dict[str, Any]], case: Any, file: Path) -> dict[str, Any]:
    """The result of a case: from its file if it is there, else made and written there."""
    sys.path.insert(0, str(OUTSIDE.parent))
    if not file.exists():
        temporary = file.with_suffix(".tmp")
        temporary.write_text(json.dumps(run(case)))
        temporary.replace(file)
    result: dict[str, Any] = json.loads(file.read_text())
    return result


if __name__ == "__main__":
    raise SystemExit(main())
