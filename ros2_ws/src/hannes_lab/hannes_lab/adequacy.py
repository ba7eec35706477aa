"""Whether a set of effects explains what the model as it is does not, and in what it falls short."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from hannes_description.output import with_unit

from .chance import Chance
from .scan import period_of
from .search import FAR, PULLED, Candidate, Search
from .spectrum import turn
from .trials import Trial

ADEQUATE = 1.25
"""A set of effects is adequate if its cost is at most this multiple of what chance reaches: room for the linear
approximation behind the critical value.  Where the model has an error of its own, whose width has room enough, 1."""

OWN_ERROR_MOST = 2.4
"""Standard deviations of the model's own error that the error of one signal of one condition may reach as a root mean
square.  A large error in few is lost in the sum over all: then what is left is not the model's form, but something
that is missing."""

IMPLAUSIBLE = 8.0
"""Standard deviations of its prior at which a nominal parameter is called far off, and beyond which no set of effects
that needs it there is adequate: an effect may fit well whose only merit is that it replaces what the model had."""

EXTREME = 8.0
"""Typical strengths beyond which no effect is believed where the model has an error of its own: a set that has room to
be wrong bends what it has into any curve (a slack of 40 % of the travel and a weight of nine times the usual, for a
catch at that place)."""

ALONE = 2.0
"""How many times that a single effect may be: two can bend each other, one that explains all by itself is it."""

DISTORTED, WAVES = 2.5, 3.0
"""Standard deviations, root of the sum of the squares, that the shapes of a periodic effect may be off from what is
usual of them where fewer than so many of its waves fit into the travel: bent further it stands for a curve that does
not repeat.  Waves that repeat may have any form: of the ripple of EMPS, 98 waves, the third harmonic is as large as the
first.  Where not even one wave fits in, nothing repeats, and another machine's form is nearer than a ripple."""

AS_IT_REPEATS = 1.25
"""An error on held-out conditions, in multiples of the repeatability, that leaves nothing to look for on a real
machine: chance makes it 1, and up to this where five repeats differ by one parameter, such as their friction (95 % of
(4 + chi-square of one degree) / 5, root).  What a model of the right form has of its own is less than its repeats."""


def is_adequate(search: Search, candidate: Candidate, limits: Chance, room: float = ADEQUATE) -> bool:
    """Whether chance, with the model's own error if it has one, explains what a set leaves."""
    if disbelieved(search, candidate):
        return False
    if search.problem.discrepancy:
        return candidate.fit.cost <= limits.misfit and worst_error(search, candidate)[1] <= OWN_ERROR_MOST
    return candidate.fit.cost <= limits.misfit * room


def worst_error(search: Search, candidate: Candidate) -> tuple[str, float]:
    """Where the error is largest in standard deviations of the model's own error; 0 if it has none."""
    errors = search.problem.own_errors(candidate.fit.residual)
    block, error = max(errors, key=lambda item: item[1], default=(None, 0.0))
    return (f"{block.signal} of '{block.condition}'" if block else "", error)


def apart(search: Search, candidate: Candidate) -> str:
    """The parameter of single recordings that differs more between them than it may, in words; empty if none does."""
    families: dict[str, list[tuple[float, float]]] = {}
    for nuisance in search.nuisances:
        family, of_one, _ = nuisance.name.partition("@")
        z = candidate.fit.z_of(nuisance.name)
        if of_one and z is not None:
            families.setdefault(family, []).append((z, nuisance.apart))
    for family, own in families.items():
        mean = sum(z for z, _ in own) / len(own)
        farthest = max(abs(z - mean) for z, _ in own)
        if any(abs(z - mean) > most for z, most in own):
            return f"{family} differs between recordings of one machine by {farthest:.0f} times its tolerance"
    return ""


def implausible(candidate: Candidate) -> str:
    """The well-known parameter that is farther off than IMPLAUSIBLE, in words; empty if none is."""
    known = candidate.fit.model.names
    c, off = next(((c, z) for c, z in candidate.fit.off if not c.wide and c.name in known), (None, 0.0))
    if c is None or off <= IMPLAUSIBLE:
        return ""
    return (
        f"{c.name} would be {with_unit(candidate.fit.values[c.name], c.unit, 3)} instead of {c.value(0.0):.3g}, "
        f"{off:.0f} times its tolerance off: if the nominal model is not that of this machine, calibrate it first"
    )


def exaggerated(search: Search, candidate: Candidate) -> str:
    """The effect that is stronger than EXTREME where the model has an error of its own, in words; or empty."""
    if not search.problem.discrepancy:
        return ""
    most = EXTREME * (ALONE if len(candidate.names) == 1 else 1.0)
    for effect in candidate.names:
        for p in search.effect(effect).parameters:
            name = f"{effect}.{p.name}"
            strength = abs(candidate.fit.z_of(name) or 0.0)
            if p.vanishing is not None and strength > most:
                return (
                    f"{name} would be {with_unit(candidate.fit.values[name], p.unit, 3)}, {strength:.0f} times what is "
                    "typical: it stands for something else"
                )
    return ""


def unshown(search: Search, candidate: Candidate, error: float) -> str:
    """The wave of a set that the way is too short to show repeat, where more is left than repeats leave, in words.

    On a machine of others only; empty if there is none.  One of fewer than WAVES waves may stand for any curve of the
    position: it is believed where it is all that is missing.

    error   on what took no part in the fit, in multiples of the repeatability
    """
    if not (search.problem.of_others and error > AS_IT_REPEATS):
        return ""
    for effect in candidate.names:
        if (waves := waves_of(search, candidate, effect)) < WAVES:
            return (
                f"{effect}, of {waves:.1f} waves in all, would leave {error:.2f} times the repeatability: the way does "
                "not show that it repeats, and it may stand for another curve of the position"
            )
    return ""


def disbelieved(search: Search, candidate: Candidate) -> str:
    """Why a set is no answer whatever it explains, in words; empty if it may be one."""
    return (
        apart(search, candidate)
        or implausible(candidate)
        or distorted(search, candidate)
        or exaggerated(search, candidate)
    )


def in_the_law(search: Search, candidate: Candidate) -> tuple[str, str]:
    """The first effect of a set that is no more than how another machine's law sets in, and how much, in words.

    Only where the model has an error of its own: it has room for that.  Empty strings if there is none.
    """
    for effect in candidate.names if search.problem.discrepancy else ():
        if below := search.effect(effect).law_below:
            parameter, part = below
            travel = max(_travel(trial) for trial in search.problem.features.trials)
            value = candidate.fit.values[f"{effect}.{parameter}"]
            if value < part * travel:
                (unit,) = (p.unit for p in search.effect(effect).parameters if p.name == parameter)
                return effect, f"{parameter} {value:.2g} {unit}, {100.0 * value / travel:.2g} % of the travel"
    return "", ""


def _travel(trial: Trial) -> float:
    """How far a recording's encoder goes, or, without one, its reference."""
    if "encoder_position" in trial.signals:
        return float(np.ptp(trial.signals["encoder_position"][1]))
    return trial.span


def waves_of(search: Search, candidate: Candidate, effect: str) -> float:
    """How many periods of an effect of a set the machine passes on its way; infinite for one that has no period."""
    period = period_of(search.effect(effect))
    if period is None:
        return math.inf
    wrapped = turn(search.problem, candidate.fit)
    travel = max(
        float(np.ptp(np.unwrap(trial.reference, period=wrapped))) if wrapped else _travel(trial)
        for trial in search.problem.features.trials
    )
    return travel / candidate.fit.values[f"{effect}.{period.name}"]


def distorted(search: Search, candidate: Candidate, among: Sequence[str] | None = None) -> str:
    """The effect of less than one wave, or of few whose shapes are farther off than DISTORTED, in words; or empty.

    among   of these effects only
    """
    fit = candidate.fit
    for effect in candidate.names if among is None else among:
        waves = waves_of(search, candidate, effect)
        shapes = {
            f"{effect}.{p.name}": fit.z_of(f"{effect}.{p.name}") or 0.0
            for p in search.effect(effect).parameters
            if p.sd
        }
        if waves < 1.0 and search.problem.of_others:
            return (
                f"{effect}, of {waves:.1f} waves in all, would repeat nowhere: it stands for something else"
            )
        if waves < WAVES and math.hypot(*shapes.values()) > DISTORTED:
            name = max(shapes, key=lambda n: abs(shapes[n]))
            return (
                f"{effect}, of {waves:.1f} waves in all, would be of another form than is usual of it "
                f"({name} {fit.values[name]:.2g}): it stands for something else"
            )
    return ""


def led_off(base: Candidate, best: Candidate, by: Sequence[str] = ()) -> str:
    """The well-known parameter that effects take far off and that is near its nominal value without them, in words.

    They replace what the model had.  Empty if there is none.

    by   the effects that do, if not all of them
    """
    known = best.fit.model.names
    for c, off in best.fit.off:
        if off > PULLED and not c.wide and c.name in known and abs(base.fit.z_of(c.name) or 0.0) < FAR:
            return (
                f"{' and '.join(by or best.names)} would take {c.name} to "
                f"{with_unit(best.fit.values[c.name], c.unit, 3)} instead of {c.value(0.0):.3g}, "
                f"{off:.0f} times its tolerance off, where it is not without: what is missing has another form"
            )
    return ""


def leads_back(base: Candidate, other: Candidate | None = None) -> bool:
    """Whether a set has all well-known parameters near their nominal values again of which its base has some far off.

    They had taken over what an effect does.  Without a set: whether there is any to lead back.
    """
    known = base.fit.model.names
    far = [c.name for c, off in base.fit.off if off > PULLED and not c.wide and c.name in known]
    return bool(far) and (other is None or all(abs(other.fit.z_of(name) or 0.0) < FAR for name in far))


def shortfall(search: Search, best: Candidate, limits: Chance) -> str:
    """In what a set that is not adequate falls short."""
    if best.fit.cost > limits.misfit:
        return f"misfit {best.fit.cost:.0f} stays above what chance reaches ({limits.misfit:.0f})"
    if why := disbelieved(search, best):
        return why
    where, error = worst_error(search, best)
    return f"error in {where} is {error:.1f} times as large as a model of this form is allowed to be off"
