"""Whether signals of a recording that nobody described are by clocks of their own: then they are moved, and said.

Drivers and computers hold signals back, each another time.  A few ms hide in what a model may be off; 30 ms bend a fit,
and what is read off the signals before it, until a hidden effect is not found any more.  But delays that are free where
all signals are in time lead searches astray too, so there are none unless the fitted nominal model comes much nearer.
"""

from __future__ import annotations

from dataclasses import replace

from .fit import fit
from .hand import SIGNAL_DELAY, HandRig
from .lags import moved_back
from .prepare import Prepared, prepare
from .search import WHOLE, Search

MUCH = 0.8
"""Part of the fitted nominal model's cost that delays must leave at most."""


def in_time(prepared: Prepared, search: Search) -> tuple[Prepared, Search]:
    """The same, or where delays of single signals are needed, with these moved back; what is left of them is fitted.

    Only a hand's recordings may be by several clocks; a search through a surrogate is left as it is.
    """
    rig = prepared.rig
    delays = rig.delays() if isinstance(rig, HandRig) and not search.slow else []
    if not delays:
        return prepared, search
    without = search.null().fit
    found = search.with_nuisances([*search.nuisances, *delays]).null().fit
    if found.cost > MUCH * without.cost:
        return prepared, search
    # The fit without them may only have ended in a worse valley.
    start = {name: z for name, z in found.point.items() if name in without.point}
    again = fit(search.problem, search.model, without.coordinates, start, evaluations=WHOLE)
    if found.cost > MUCH * again.cost:
        return prepared, search
    late = {delay.name.removeprefix(SIGNAL_DELAY): found.values[delay.name] for delay in delays}
    signals = list(dict.fromkeys(block.signal for block in prepared.features.blocks))
    trials = moved_back(prepared.features.trials, late, "the encoder and the fitted nominal model say")
    new = prepare(trials, prepared.model, signals=signals)
    notes = tuple(dict.fromkeys((*prepared.notes, *new.notes)))
    return replace(new, notes=notes), search.on(new.problem, new.nuisances)
