"""What commands and the page do alike: recordings and model made ready, effects tried, the model before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.signals import SIGNALS
from hannes_sim.effect import effect_source, load_effect

from .add import Addition
from .cache import Store
from .compare import Comparison, compare
from .diagnosis import Diagnosis
from .executor import Executor
from .hand import NOMINAL, model_of
from .own_effect import along_reference, check_own_effects, first_closure
from .prepare import Prepared, load_trials, prepare, read_trials
from .rig import PlantRig, load_rig
from .trials import UNITS, Trial, stem_of


def prepared_from(
    bags: Sequence[Path],
    model: str | None,
    objects: Sequence[str] | None,
    signals: Sequence[str] | None,
    rig: str | None = None,
    scale: Sequence[str] | None = None,
    threads: int = 1,
    topics: Sequence[str] | None = None,
    leave_out: Sequence[str] | None = None,
) -> Prepared:
    """Recordings and a model, ready; the options are those of the command line, as texts.

    model    None: that of the adapter, or the shipped one whose plant made the recordings, as they say
    threads  see prepare
    """
    machine, trials = trials_from(bags, objects, rig, scale, topics)
    given = model or (str(machine.model) if machine else model_of(trials))
    out = prepare(
        trials,
        Model.load(given),
        rig=machine,
        signals=signals,
        surrogate=True,
        threads=threads,
        leave_out=closures_named(leave_out),
    )
    if model or machine or given == NOMINAL:
        return out
    note = (
        f"the recordings say that they are of the plant of model {given}, so that is compared; --model {NOMINAL} is "
        "faster, and compares them as another machine's"
    )
    return replace(out, notes=(note, *out.notes))


def trials_from(
    bags: Sequence[Path],
    objects: Sequence[str] | None = None,
    rig: str | None = None,
    scale: Sequence[str] | None = None,
    topics: Sequence[str] | None = None,
) -> tuple[type[PlantRig] | None, list[Trial]]:
    """What is read of recordings, and the class of the adapter that reads them, if one is named."""
    machine = load_rig(rig) if rig else None
    given = {}
    for text in objects or ():
        name, _, what = text.partition("=")
        if not what:
            raise HannesError(f"--object {text}: give CONDITION=none|soft|rigid.")
        given[name] = what
    factors = _factors(scale)
    if machine and factors:
        raise HannesError("--scale is for bags; with --rig the adapter's reader says what the units are.")
    if machine and topics:
        raise HannesError("--topic is for bags; with --rig the adapter's reader says where the signals are.")
    trials = (
        read_trials(machine, bags)
        if machine
        else load_trials(bags, scale=factors, objects=given, topics=_topics(topics))
    )
    known = ({t.name, stem_of(t.source), *(part.name for part in t.parts)} for t in trials)
    unknown = sorted(set(given).difference(*known))
    if unknown:
        raise HannesError(
            f"--object names unknown conditions {', '.join(unknown)}; these bags have "
            f"{', '.join(t.name for t in trials)}."
        )
    trials = [
        replace(t, options={**t.options, "object": given[t.name]}) if t.name in given else t for t in trials
    ]
    return machine, trials


def _factors(scale: Sequence[str] | None) -> dict[str, float]:
    """Factors to SI by signal name."""
    out = {}
    for text in scale or ():
        name, _, factor = text.partition("=")
        try:
            out[name] = float(factor)
        except ValueError:
            out[name] = math.nan
        if not (math.isfinite(out[name]) and out[name] != 0.0):
            raise HannesError(f"--scale {text}: give SIGNAL=FACTOR with a number that is not 0.")
        if name not in ("reference_position", *UNITS):
            raise HannesError(
                f"--scale {text}: unknown signal; valid are {', '.join(('reference_position', *UNITS))}."
            )
    return out


def _topics(given: Sequence[str] | None) -> dict[str, str | None]:
    """Topics by signal name; None leaves the signal out."""
    out: dict[str, str | None] = {}
    for text in given or ():
        name, equals, topic = text.partition("=")
        if not equals or name not in SIGNALS:
            raise HannesError(
                f"--topic {text}: give SIGNAL=TOPIC, or SIGNAL= to leave it out; signals are {', '.join(SIGNALS)}."
            )
        if name in out:
            raise HannesError(f"--topic {text}: another topic is named for {name} already.")
        out[name] = topic or None
    return out


def closures_named(given: Sequence[str] | None) -> dict[str, tuple[int, ...]]:
    """Numbers of closures, from 1 on, by condition."""
    out: dict[str, tuple[int, ...]] = {}
    for text in given or ():
        name, _, numbers = text.rpartition("=")
        try:
            more = tuple(int(number) for number in numbers.split(","))
        except ValueError:
            more = ()
        if not name or not more or min(more) < 1:
            raise HannesError(
                f"--leave-out {text}: give CONDITION=NUMBER, or several numbers with commas between; the first closure "
                "is 1."
            )
        out[name] = (*out.get(name, ()), *more)
    return out


def executor_of(jobs: int, dask: str | None = None, no_cache: bool = False) -> Executor:
    """Where the work is done and its results are kept: worker processes or a Dask cluster, and the user's store."""
    return Executor(jobs, dask, None if no_cache else Store())


def try_effects(prepared: Prepared, sources: Sequence[str]) -> None:
    """Try the user's own effects on the shortest closure before working with them."""
    trial, reference = first_closure(prepared.features.trials)

    def simulate(source: str) -> None:
        kind = prepared.rig.effect(load_effect(source))
        entry = kind.entry({p.name: p.typical for p in kind.parameters}, source=effect_source(source))
        prepared.rig.simulate(prepared.model.with_effect(entry), {}, trial, reference)

    check_own_effects(sources, simulate, along_reference(trial, reference))


def before(prepared: Prepared, found: Diagnosis | Addition) -> Comparison:
    """The given model beside the recordings: fitted, where something was added to it, so that this is all they differ
    in."""
    return compare(
        found.moved or prepared, values=found.nominal if found.effects else None, fitted=bool(found.effects)
    )


def after(prepared: Prepared, found: Diagnosis | Addition) -> Comparison:
    """The model with what was found beside the recordings."""
    return compare(replace(found.moved or prepared, model=found.model), values=found.values)
